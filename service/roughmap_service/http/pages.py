"""The pages: ``/healthz``, ``/readyz``, ``/metrics``, and ``/``, an overview that links them."""

from html import escape

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from roughmap_schemas.messages import MapStatus
from roughmap_service.host.log_growth import GROWTH, growth_text
from roughmap_service.http.access import AUTHORISED
from roughmap_service.watch.readiness import Readiness, Sources, is_ready

METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>roughmap: {map}</title></head><body>
<h1>roughmap {version}: {map}</h1>
<p>{health}: {why}</p>
<table>
{rows}
</table>
<p><a href="healthz">healthz</a> (alive) &middot; <a href="readyz">readyz</a> (accepting messages and answering queries)
&middot; <a href="metrics">metrics</a> (Prometheus)</p>
</body></html>
"""


def application(sources: Sources) -> Starlette:
    """Return the pages as an application.

    A new page is a function here and a path in ``pages``. A page that may wait for a scan's integration is a plain
    function, which Starlette runs in a thread; a page that never waits is a coroutine.
    """

    async def healthz(request: Request) -> Response:
        name = {"map": sources.map} if request.scope[AUTHORISED] and sources.map else {}
        return JSONResponse({"alive": True, **name})

    async def readyz(request: Request) -> Response:
        problems = sources.readiness.problems()
        ready = is_ready(problems)
        if not request.scope[AUTHORISED]:
            page = {"ready": ready, "problems": dict.fromkeys(problems, "")}
        else:
            log = sources.log().model_dump(include=GROWTH)
            page = {"ready": ready, "problems": problems, "recent": sources.recent(), "log": log}
        return JSONResponse(page, 200 if ready else 503)

    def metrics(_: Request) -> Response:
        if sources.metrics is None:
            return PlainTextResponse("the service is starting\n", 503)
        return Response(sources.metrics(), media_type=METRICS_TYPE)

    def overview(_: Request) -> Response:
        if sources.status is None:
            return PlainTextResponse("the service is starting\n", 503)
        return HTMLResponse(_page(sources.status(), sources.readiness))

    pages = {"/": overview, "/healthz": healthz, "/readyz": readyz, "/metrics": metrics}
    app = Starlette(routes=[Route(path, page, methods=["GET"]) for path, page in pages.items()])
    app.router.redirect_slashes = False  # it would redirect to the host that the request names
    return app


def _page(status: MapStatus, readiness: Readiness) -> str:
    causes = [escape(line) for cause in readiness.problems().values() for line in cause.split("\n")]
    causes = causes or ["accepting messages and answering queries"]
    why = "<br>".join([*causes, *(f"recently: {escape(text)}" for text in status.recent)])
    rows = {
        "sequence": f"{status.sequence}, on disk up to {status.durable_sequence}",
        "up for": f"{status.uptime_s:.0f} s",
        "clouds": f"{status.clouds.accepted:,} ({status.rates.clouds:.1f}/s), {status.clouds.waiting} waiting",
        "points": f"{status.points.accepted:,} ({status.rates.points:,.0f}/s)",
        "poses": f"{status.poses.accepted:,} ({status.rates.poses:.1f}/s)",
        "tiles": f"{status.tiles.resident:,} in memory, {status.tiles.spilled:,} spilled",
        "log": growth_text(status.log.bytes_per_hour, status.log.hours_to_full_disk, status.log.keep),
        "memory": f"{status.memory_bytes / 2**20:,.0f} MiB",
    }
    table = "\n".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows.items())
    return PAGE.format(
        map=escape(status.map), version=escape(status.version), health=escape(status.health), why=why,
        rows=table,
    )  # fmt: skip
