"""Chromium without a screen, driven by Selenium, which is imported only when a browser is
opened."""

from contextlib import contextmanager
from importlib import import_module
from shutil import which

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
def chromium(*flags):
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


def resize(driver, width, height=900):
    """Let pages have this size [CSS pixels]."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def problems(driver):
    """What the browser has complained of since the last call."""
    return [line["message"] for line in driver.get_log("browser") if line["level"] == "SEVERE"]
