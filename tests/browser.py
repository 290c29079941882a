"""A headless Chromium for tests of pages."""

import contextlib
import functools
import http.server
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

_OPTIONS = ("headless=new", "no-sandbox", "disable-gpu", "disable-dev-shm-usage")
# No page may need another machine: names of hosts lead nowhere.
_OFFLINE = "host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost"


@contextlib.contextmanager
def chromium(width: int = 1200, height: int = 1000):
    """A browser without a network; a test is skipped where it or its driver is not installed."""
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for option in (*_OPTIONS, _OFFLINE, f"window-size={width},{height}"):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield browser
    finally:
        browser.quit()


def complaints(browser: Any) -> list[str]:
    """What the console said since it was last asked."""
    return [entry["message"] for entry in browser.get_log("browser")]


@contextlib.contextmanager
def served(folder: Path):
    """The address at which the files of a folder are served."""

    class Silent(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *arguments):
            pass

    handler = functools.partial(Silent, directory=str(folder))
    with http.server.ThreadingHTTPServer(("localhost", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://localhost:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
