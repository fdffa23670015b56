"""Films for the tests of the page, records of their jobs, and drawing on their frames."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
from PIL import Image
from playwright.sync_api import Page, Route

WIDTH, HEIGHT = 320, 240
RED, BLUE = (40, 40, 210), (210, 40, 40)  # BGR

KEEP_SENT = """() => {
  const send = XMLHttpRequest.prototype.send;
  XMLHttpRequest.prototype.send = function (form) {
    window.sent = [...form].map(([name, value]) => [name, value instanceof File ? value.name : value]);
    return send.call(this, form);
  };
}"""
"""Makes the page remember the names and values of the form that it sends, in `window.sent`."""


def picture(colour: tuple[int, int, int], name: str = ".png") -> bytes:
    frame = np.full((HEIGHT, WIDTH, 3), colour, np.uint8)
    cv2.circle(frame, (WIDTH // 2, HEIGHT // 2), 70, (235, 235, 235), -1)
    return bytes(cv2.imencode(name, frame)[1])


def films_in(folder: Path) -> dict[str, bytes]:
    """Films of six frames, the first of them red, the others blue; an mp4 in a codec that browsers do not decode."""
    found = {}
    frames = [cv2.imdecode(np.frombuffer(picture(RED if i == 0 else BLUE), np.uint8), 1) for i in range(6)]
    for name, codec in (("film.webm", "VP80"), ("old.mp4", "mp4v")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter_fourcc(*codec), 5, (WIDTH, HEIGHT))
        assert writer.isOpened()
        for frame in frames:
            writer.write(frame)
        writer.release()
        found[name] = (folder / name).read_bytes()
    listed = io.BytesIO()
    with zipfile.ZipFile(listed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("film/10.png", picture(BLUE))
        archive.writestr("film/9.png", picture(RED))
        archive.writestr("__MACOSX/film/._1.png", b"not a picture")
    return {**found, "pictures.zip": listed.getvalue(), **moving()}


def moving() -> dict[str, bytes]:
    """The same six frames as a zip of pictures and as an animation."""
    pictures = [picture(RED if i == 0 else BLUE) for i in range(6)]
    listed, animation = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(listed, "w") as archive:
        for index, each in enumerate(pictures):
            archive.writestr(f"{index}.png", each)
    first, *others = (Image.open(io.BytesIO(each)) for each in pictures)
    # Equal frames would be joined to one.
    others = [Image.fromarray(np.asarray(each) // 8 * 8 + np.uint8(index)) for index, each in enumerate(others)]
    first.save(animation, "GIF", save_all=True, append_images=others, duration=60)
    return {"moving.zip": listed.getvalue(), "moving.gif": animation.getvalue()}


def with_film_options(route: Route) -> None:
    schema = httpx.get(route.request.url).json()  # not `route.fetch`, which fails once the page has navigated away
    schema["properties"].setdefault("region_polygon", {"type": "array", "default": None, "description": "Drawn."})
    route.fulfill(json=schema)


def film_record(url: str, finished: str, **fields: Any) -> dict[str, Any]:
    """Return the record of a running film job, derived from that of a finished job."""
    record = httpx.get(f"{url}/v1/jobs/{finished}").json()
    read = {"num_frames": 6, "num_points": 0, "num_faces": 0, "mesh_source": "film", "format": "film (webm)"}
    notes = ["A film of 320×240 pixels, 6 frames, 5 frames per second. Its points are not tracked yet."]
    record["interpretation"] |= {**read, "notes": notes, "has_ground_truth": False}
    progress = {"stage": "track", "fraction": 0.2, "updated_at": record["finished_at"], "seconds_left": 30.0}
    progress |= {"reweighting": 0, "max_reweightings": 0, "objective": None, "residual": None}
    running = {"status": "running", "progress": progress, "metrics": None, "artifacts": [], "finished_at": None}
    return {**record, **running, "name": "a film", "sentence": None, **fields}


def answer_with(page: Page, record: dict[str, Any]) -> None:
    def jobs(route: Route) -> None:
        if route.request.method == "POST":
            route.fulfill(status=202, json=record)
        else:
            route.fulfill(json={"jobs": [record], "next": None})

    page.route("**/v1/jobs", jobs)
    page.route("**/v1/jobs?*", jobs)
    page.route(f"**/v1/jobs/{record['id']}", lambda route: route.fulfill(json=record))
    page.route(f"**/v1/jobs/{record['id']}/events", lambda route: route.fulfill(status=404, json={}))


def drag(page: Page, *places: tuple[float, float]) -> None:
    """Drag through points given as fractions of the picture's width and height."""
    box = page.get_by_role("application").bounding_box()
    assert box is not None
    at = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in places]
    page.mouse.move(*at[0])
    page.mouse.down()
    for place in at[1:]:
        page.mouse.move(*place, steps=6)
    page.mouse.up()


def colour_at_corner(page: Page) -> list[int]:
    canvas = page.get_by_role("img", name="First frame of the film")
    read = "(it) => [...it.getContext('2d').getImageData(4, 4, 1, 1).data].slice(0, 3)"
    return list(canvas.evaluate(read))


def sent_options(page: Page) -> dict[str, Any]:
    return dict(json.loads(dict(page.evaluate("window.sent"))["options"]))
