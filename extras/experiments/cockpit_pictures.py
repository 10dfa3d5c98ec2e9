"""Draws figures/cockpit.png, and measures how quick the cockpit is.

    extras/.venv/bin/python -m extras.experiments.cockpit_pictures

Needs Debian's packages chromium and chromium-driver; the page itself does not. The picture: a
flight of the network, and why it turns. Then it prints the milliseconds from a step's begin to its
frame, and from the question why to the answer. Takes half a minute.
"""

import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from selenium import webdriver
from selenium.common.exceptions import JavascriptException
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait

from extras.cockpit.__main__ import Server
from extras.cockpit.episodes import ROOT, Hangar

CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


@contextmanager
def serving(root: Path = ROOT) -> Iterator[str]:
    """A cockpit at any free port; its address. root: where its networks and trainings are."""
    server = Server(0, Hangar(root))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@contextmanager
def browsing(
    width: int = 1280, height: int = 720, mobile: bool = False, **prefs: object
) -> Iterator[webdriver.Chrome]:
    """A Chromium with a window of so many pixels, and its downloads in `browser.downloads`. mobile:
    with a finger for a pointer. prefs: of Chromium, by their names."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        prefs |= {"download.default_directory": folder}
        options.add_experimental_option("prefs", prefs)
        for flag in (*FLAGS, f"--user-data-dir={folder}/profile"):
            options.add_argument(flag)
        browser = webdriver.Chrome(options, Service(str(DRIVER)))
        browser.downloads = Path(folder)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": mobile})
        yield browser
        browser.quit()


def value(browser: webdriver.Chrome, script: str) -> Any:
    """Of an expression of the page's script."""
    return browser.execute_script(f"return {script}")


def until(browser: webdriver.Chrome, script: str) -> Any:
    """Wait until an expression of the page's script is true, half a minute at most."""
    soon = WebDriverWait(browser, 30, 0.05, [JavascriptException])  # the page may not be there yet
    return soon.until(lambda _: value(browser, script))


def visit(browser: webdriver.Chrome, host: str, **episode: object) -> None:
    """Open the page at an episode, as its address says; wait until it and the ghost are there."""
    after = "&".join(f"{key}={x}" for key, x in episode.items())
    browser.get("about:blank")
    browser.get(f"http://{host}/#{after}")
    until(browser, "episode && (byHand() || over()) && (ghost || chosen.pilot === 'network')")


def picture(browser: webdriver.Chrome, host: str) -> bytes:
    """The network's flight through forest 7, and why it turns as it does."""
    visit(browser, host, seed=7, pilot="network", t=40)
    value(browser, "actions.why()")
    until(browser, "reasons")
    return browser.get_screenshot_as_png()


def latencies(browser: webdriver.Chrome, host: str) -> dict[str, list[float]]:
    """Milliseconds of every step while the network's ghost flies along, and of ten questions."""
    visit(browser, host, seed=42)
    script = "performance.getEntriesByName('step to frame').map((entry) => entry.duration)"
    for _ in range(4):
        ActionChains(browser).send_keys(Keys.SPACE).perform()
        until(browser, "over()")
        value(browser, "actions.again()")
    steps = value(browser, script)
    visit(browser, host, seed=42, pilot="network", t=0)
    ask = """const [done, times] = [arguments[0], []];
        (async () => {
          for (let i = 0; i < 10; i++) {
            stepTo(10 * i);
            const start = performance.now();
            await why();
            times.push(performance.now() - start);
          }
          done(times);
        })();"""
    return {"step to frame": steps, "why": browser.execute_async_script(ask)}


def main() -> None:
    """Draw the figure, and print the milliseconds."""
    with serving() as host, browsing(1000, 1020) as browser:
        image = Image.open(BytesIO(picture(browser, host))).convert("RGB")
        times = latencies(browser, host)
    image.quantize(256).save(ROOT / "figures/cockpit.png", optimize=True)
    for name, x in times.items():
        middle, late = np.percentile(x, [50, 95])
        print(f"{name}: {len(x)} times, 50 % within {middle:.1f} ms, 95 % within {late:.1f} ms")


if __name__ == "__main__":
    main()
