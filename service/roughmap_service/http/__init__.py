"""The HTTP server: its pages, who may read them, and its limits."""
