"""The HTTP server: its pages, who may read them, and its limits.

    server.py   the socket and the thread: `HttpServer`
    pages.py    the pages; a new page goes here
    access.py   which requests are answered: method, token, host
    limits.py   how many connections, and for how long
    token.py    the token from the settings

Other rooms import `HttpServer` and `PortTaken` (server.py), `token_of` and `HttpError` (token.py). Only server.py
imports the other modules, in its own thread: loading Starlette and uvicorn takes a tenth of a second.
"""
