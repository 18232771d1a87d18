"""What `roughmap doctor` says of disks, memory, ports, certificates, tokens."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from certificate_files import certificate
from http_tools import address, pages

from roughmap_schemas.config import Config
from roughmap_schemas.config_load import load_config
from roughmap_schemas.sections import HttpConfig
from roughmap_service.cli.doctor import machine as doctor_machine
from roughmap_service.cli.doctor.certificates import certificates, validity
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.security import http_access, zenoh_access
from roughmap_service.watch.readiness import Readiness, Sources

NOW = datetime(2030, 6, 1, tzinfo=UTC)
DAY = timedelta(days=1)


def test_a_directory_that_can_be_written_with_room(tmp_path: Path) -> None:
    log, store = {"directory": str(tmp_path / "a" / "b"), "max_file_bytes": 1}, {"path": str(tmp_path / "map.db")}
    config = Config.model_validate({"log": log, "store": store, "map": {"memory_limit": 1}})
    assert [finding.verdict for finding in doctor_machine.directories(config)] == ["ok", "ok"]
    assert not (tmp_path / "a").exists(), "a look changes nothing"
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_is_none_or_without_room(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (log,) = doctor_machine.directories(Config.model_validate({"log": {"directory": str(tmp_path / "file" / "log")}}))
    assert (log.verdict, "is not writable" in log.text, "log.directory" in log.remedy) == ("wrong", True, True)
    large = Config.model_validate({"log": {"directory": str(tmp_path), "max_file_bytes": "1000TiB"}})
    (log,) = doctor_machine.directories(large)
    assert (log.verdict, log.remedy) == ("note", "free some space")


def test_memory_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor_machine.memory(Config.model_validate({"map": {"memory_limit": "1000TiB"}})).verdict == "wrong"
    small = Config.model_validate({"map": {"memory_limit": "1MiB"}})
    monkeypatch.setattr(doctor_machine, "CGROUP_LIMITS", (tmp_path / "none", tmp_path / "limit"))
    (tmp_path / "limit").write_text("max\n")
    assert doctor_machine.memory(small).verdict == "ok"
    (tmp_path / "limit").write_text(str(100 << 20))
    found = doctor_machine.memory(small)
    assert (found.verdict, "the container has 0.1 GiB" in found.text) == ("wrong", True)


@pytest.mark.parametrize(("year", "verdict"), [(1970, {"wrong"}), (2030, {"ok", "note"}), (2200, {"wrong"})])
def test_a_clock_that_cannot_be(monkeypatch: pytest.MonkeyPatch, year: int, verdict: set[str]) -> None:
    stamp = datetime(year, 1, 1, tzinfo=UTC).timestamp()
    monkeypatch.setattr(doctor_machine.time, "time", lambda: stamp)
    assert doctor_machine.clock().verdict in verdict


def test_a_port_that_is_taken() -> None:
    def looked(listen: str, name: str = "site", *, running: bool = False) -> Finding:
        config = Config.model_validate({"map": {"name": name}, "http": {"listen": listen}})
        return doctor_machine.http_port(config, running=running)

    assert looked("").verdict == "ok"
    assert looked("127.0.0.1:0").verdict == "ok"
    with pages(Sources(Readiness(), "other")) as server:
        listen = "{}:{}".format(*address(server))
        found = looked(listen)
        assert (found.verdict, "Address already in use" in found.text) == ("wrong", True)
        assert looked(listen, running=True).verdict == "note", "another map's pages"
        assert looked(listen, "other", running=True).verdict == "ok"
    assert looked("127.0.0.1:0", running=True).verdict == "ok"


@pytest.mark.parametrize("years", [1, 40, 400], ids=["UTCTime", "GeneralizedTime", "far"])
def test_the_dates_of_a_certificate(tmp_path: Path, years: int) -> None:
    begin, end = NOW, NOW + years * 365 * DAY
    path, _ = certificate(tmp_path, "one", begin, end)
    assert validity(ssl.PEM_cert_to_DER_cert(path.read_text())) == (begin, end)


def test_no_cut_of_a_certificate_is_taken_for_one(tmp_path: Path) -> None:
    path, _ = certificate(tmp_path, "one", NOW, NOW + DAY)
    der = ssl.PEM_cert_to_DER_cert(path.read_text())
    for length in range(len(der)):
        with pytest.raises((ValueError, IndexError)):
            validity(der[:length])


def tls(**names: Path) -> zenoh.Config:
    config = zenoh.Config()
    for name, path in names.items():
        config.insert_json5(f"transport/link/tls/{name}", f'"{path}"')
    return config


def test_certificates_by_their_dates(tmp_path: Path) -> None:
    cases: list[tuple[datetime, datetime, str, str]] = [
        (NOW - DAY, NOW + 400 * DAY, "ok", "400 days left"),
        (NOW - DAY, NOW + 29 * DAY, "note", "29 days left"),
        (NOW - 2 * DAY, NOW - DAY, "wrong", "expired 2030-05-31 00:00 UTC"),
        (NOW + DAY, NOW + 2 * DAY, "wrong", "not valid before 2030-06-02 00:00 UTC"),
    ]
    for number, (begin, end, verdict, words) in enumerate(cases):
        path, key = certificate(tmp_path, f"c{number}", begin, end)
        found = certificates(tls(listen_certificate=path, listen_private_key=key), NOW)
        assert [finding.verdict for finding in found] == [verdict, "ok"], "the file, and its key"
        assert words in found[0].text
    old, new = tmp_path / "c2.pem", tmp_path / "c0.pem"
    both = tmp_path / "both.pem"
    both.write_text(old.read_text() + new.read_text())
    assert certificates(tls(root_ca_certificate=both), NOW)[0].verdict == "ok", "an authority that took over"
    assert certificates(tls(connect_certificate=both), NOW)[0].verdict == "wrong", "a chain with a part that ended"


def test_certificates_that_are_none_and_keys_that_do_not_fit(tmp_path: Path) -> None:
    path, key = certificate(tmp_path, "one", NOW - DAY, NOW + 400 * DAY)
    _, other = certificate(tmp_path, "other", NOW - DAY, NOW + 400 * DAY)
    assert certificates(zenoh.Config(), NOW) == []
    found = certificates(tls(listen_certificate=path, listen_private_key=other), NOW)
    assert (found[1].verdict, "is not the key of" in found[1].text) == ("wrong", True)
    key.chmod(0o644)
    found = certificates(tls(listen_certificate=path, listen_private_key=key), NOW)
    assert (found[1].verdict, found[1].remedy) == ("note", f"chmod 600 {key}")
    for content in ("", "text", "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", key.read_text()):
        path.write_text(content)
        assert certificates(tls(root_ca_certificate=path), NOW)[0].verdict == "wrong", content
    assert certificates(tls(root_ca_certificate=tmp_path / "none"), NOW)[0].verdict == "wrong"


def test_who_could_get_in_over_zenoh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def verdicts(**settings: object) -> list[str]:
        loaded = load_config(None, {f"zenoh.{name}": value for name, value in settings.items()}, {})
        return [finding.verdict for finding in zenoh_access(loaded)]

    assert verdicts() == ["ok"]
    assert verdicts(listen=["tcp/0.0.0.0:7447"])[0] == "wrong"
    assert verdicts(config_file="none.json5") == ["wrong"]
    path, key = certificate(tmp_path, "one", datetime.now(UTC) - DAY, datetime.now(UTC) + 90 * DAY)
    given = {"listen": ["tls/0.0.0.0:7447"], "certificate": str(path), "private_key": str(key), "authority": str(path)}
    assert set(verdicts(**given)) == {"ok"}


@pytest.mark.parametrize(
    ("listen", "token", "mode", "verdict"),
    [
        ("", None, 0o600, None),
        ("127.0.0.1:1", None, 0o600, None),
        ("0.0.0.0:1", None, 0o600, "wrong"),
        ("0.0.0.0:1", "", 0o600, "wrong"),
        ("0.0.0.0:1", "short", 0o600, "note"),
        ("0.0.0.0:1", "x" * 32, 0o644, "note"),
        ("0.0.0.0:1", "x" * 32, 0o600, "note"),
        ("127.0.0.1:1", "x" * 32, 0o600, "ok"),
    ],
)
def test_the_token_of_the_pages(tmp_path: Path, listen: str, token: str | None, mode: int, verdict: str | None) -> None:
    settings = {"listen": listen}
    if token is not None:
        (tmp_path / "token").write_text(token)
        (tmp_path / "token").chmod(mode)
        settings["token_file"] = str(tmp_path / "token")
    found = http_access(HttpConfig.model_validate(settings))
    assert (found.verdict if found else None) == verdict
    assert found is None or not token or token not in found.text + found.remedy
