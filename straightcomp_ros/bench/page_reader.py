"""Reads a view's events like an open page, for measuring: python -m straightcomp_ros.bench.page_reader PORT"""

import contextlib
import sys
import time
from http.client import HTTPConnection, HTTPException

_AGAIN_S = 0.2


def read(port: int) -> None:
    """Read until interrupted; reconnect like a browser whenever the view is not available."""
    while True:
        connection = HTTPConnection("127.0.0.1", port, timeout=10.0)
        with contextlib.closing(connection), contextlib.suppress(OSError, HTTPException):
            connection.request("GET", "/news")
            answer = connection.getresponse()
            while answer.readline():
                pass
        time.sleep(_AGAIN_S)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        read(int(sys.argv[1]))
