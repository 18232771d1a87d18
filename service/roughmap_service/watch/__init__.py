"""What an operator sees: status, metrics, readiness and what is wrong."""
