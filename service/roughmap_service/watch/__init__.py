"""What operators see: status, metrics, readiness, and the problems of the running service.

    readiness.py   `Problem`: what can be wrong, what it means for readiness and health
    parts.py       finds the problems of the running parts, and connects the parts with the HTTP pages
    status.py      makes the status, and publishes it
    metrics.py     makes the Prometheus metrics

All four may be imported from higher rooms. metrics.py needs prometheus_client; import it only where pages are served.
"""
