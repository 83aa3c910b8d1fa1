"""Chromium without a screen, driven by Selenium, which is imported only when a browser is
opened."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from shutil import which
from typing import Any

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """A browser with a profile of its own, whose messages are kept (``get_log("browser")``)."""
    webdriver = import_module("selenium.webdriver")
    options = webdriver.ChromeOptions()
    for flag in (*FLAGS, *flags):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(
        options=options, service=webdriver.ChromeService(which("chromedriver"))
    )
    yield driver
    driver.quit()


def resize(driver: Any, width: int, height: int = 900) -> None:
    """Let pages have this size [CSS pixels]."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def problems(driver: Any) -> list[str]:
    """What the browser has complained of since the last call."""
    return [line["message"] for line in driver.get_log("browser") if line["level"] == "SEVERE"]
