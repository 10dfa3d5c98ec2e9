"""Draws figures/cockpit.png: the cockpit at three moments, and how quick it is.

    extras/.venv/bin/python -m extras.experiments.cockpit_pictures

Needs Debian's packages chromium and chromium-driver; the page itself does not. The three moments:
an episode by hand has ended beside the network's; why the network would have turned, without one
trunk; what if it had turned the other way. Then prints the milliseconds from a step's begin to its
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

HAND = "54444444432100" + 63 * "4"  # a tap to the left, then the right key held; it crashes
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


def moments(browser: webdriver.Chrome, host: str) -> Iterator[bytes]:
    """The three pictures of the README."""
    visit(browser, host, seed=1, actions=HAND, t=len(HAND))
    yield browser.get_screenshot_as_png()
    visit(browser, host, seed=1, actions=HAND, t=7)
    value(browser, "actions.why()")
    until(browser, "reasons")
    value(browser, "why([...reasons.without].sort((a, b) => b.weight - a.weight)[0].trunk)")
    until(browser, "removed")
    yield browser.get_screenshot_as_png()
    visit(browser, host, seed=7, pilot="network", t=14)
    value(browser, "whatIf(8)")
    until(browser, "ghost")
    yield browser.get_screenshot_as_png()


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
    with serving() as host, browsing() as browser:
        pictures = [Image.open(BytesIO(png)).convert("RGB") for png in moments(browser, host)]
        times = latencies(browser, host)
    width, height = pictures[0].size
    strip = Image.new("RGB", (width * len(pictures), height))
    for i, picture in enumerate(pictures):
        strip.paste(picture, (i * width, 0))
    small = strip.resize((strip.width // 2, height // 2), Image.Resampling.LANCZOS)
    small.save(ROOT / "figures/cockpit.png", optimize=True)
    for name, x in times.items():
        middle, late = np.percentile(x, [50, 95])
        print(f"{name}: {len(x)} times, 50 % within {middle:.1f} ms, 95 % within {late:.1f} ms")


if __name__ == "__main__":
    main()
