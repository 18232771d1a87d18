"""Certificates for a whole run of tests."""

import pytest
from access import Certificates, all_certificates


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return all_certificates(tmp_path_factory.mktemp("certificates"))
