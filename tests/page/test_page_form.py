"""The form: its button, grouped options and inline errors; exporting, sharing and rerunning a finished job."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path

import httpx
import pytest
from browsing import AXE, NEEDS_CHROMIUM
from paging import TRACKS, choose, drop
from playwright.sync_api import Page, expect

pytestmark = NEEDS_CHROMIUM
SOON = 60_000


def axe_findings(page: Page) -> list[str]:
    """Return axe-core's violations; it runs in an isolated world, which the content security policy does not restrict."""
    session = page.context.new_cdp_session(page)
    world = session.send(
        "Page.createIsolatedWorld", {"frameId": session.send("Page.getFrameTree")["frameTree"]["frame"]["id"]}
    )
    where = world["executionContextId"]
    session.send("Runtime.evaluate", {"expression": AXE.read_text(encoding="utf-8"), "contextId": where})
    ran = session.send(
        "Runtime.evaluate",
        {"expression": "axe.run().then((found) => JSON.stringify(found.violations.map((one) => one.id + ': ' + one.nodes[0].html)))",
         "contextId": where, "awaitPromise": True, "returnByValue": True},
    )  # fmt: skip
    session.detach()
    return list(json.loads(ran["result"]["value"]))


def zipped(name: str) -> bytes:
    """Return a zip archive with one member of this name."""
    into = io.BytesIO()
    with zipfile.ZipFile(into, "w") as archive:
        archive.writestr(name, b"")
    return into.getvalue()


def small_targets(page: Page) -> list[str]:
    """Return visible controls smaller than 24 px in either direction; links within a sentence are exempt."""
    script = """() => [...document.querySelectorAll('button, select, input, summary, a')].filter((it) => {
      const box = it.getBoundingClientRect();
      if (box.width === 0 || it.closest('p, td, li, dd, .visually-hidden') || getComputedStyle(it).opacity === '0') return false;
      const labelled = it.labels?.[0]?.getBoundingClientRect();
      return Math.min(Math.max(box.height, labelled?.height ?? 0), Math.max(box.width, labelled?.width ?? 0)) < 24;
    }).map((it) => it.outerHTML.slice(0, 120))"""
    return list(page.evaluate(script))


@pytest.mark.usefixtures("front")
def test_the_form_shows_input_errors_inline_and_keeps_the_button_visible(page: Page) -> None:
    page.set_viewport_size({"width": 1280, "height": 720})
    send = page.get_by_role("button", name="Reconstruct")
    expect(send).to_be_in_viewport()
    table = {"name": "walk 7.csv", "mimeType": "text/csv", "buffer": b"time;name;where\n1;nose;3,5\n"}
    page.get_by_label("Tracks", exact=True).set_input_files(table)  # type: ignore[arg-type]
    alert = page.locator("[data-part=tracks]").get_by_role("alert")
    expect(alert).to_contain_text("got line 1: 'time;name;where'.")
    expect(alert).to_contain_text("Write it as in frame,point,x,y and then 0,0,312.5,200.1")
    expect(page.get_by_label("Name (optional)")).to_have_value("walk 7")
    elsewhere = {"name": "walk 8.npz", "mimeType": "", "buffer": zipped("../tracks.npy")}
    page.get_by_label("Tracks", exact=True).set_input_files(elsewhere)  # type: ignore[arg-type]
    expect(alert.get_by_role("paragraph")).to_have_text(
        [
            "Expected members named like tracks.npy, got '../tracks.npy'.",
            "Save the file again with plain array names without folders, such as tracks and visibility.",
            "What files can I send?About this errormember_name",
        ]
    )
    expect(send).to_be_in_viewport()
    page.get_by_text("Files to write", exact=True).click()
    page.get_by_label("Frame rate").fill("30")
    page.get_by_label("Frame rate").press("Tab")
    expect(page.get_by_text("(1 changed)")).to_be_visible()
    assert axe_findings(page) == []
    page.set_viewport_size({"width": 390, "height": 844})
    assert small_targets(page) == []


@pytest.mark.usefixtures("front")
def test_option_help_uses_the_words_of_the_form(page: Page) -> None:
    """For every choice of every option; names and values of the API are no words."""
    page.get_by_text("Files to write", exact=True).wait_for()
    for summary in page.locator(".folds summary").all():
        summary.click()
    shown = page.evaluate(
        """() => [...document.querySelectorAll('.folds .option')].flatMap((option) => {
          const hint = () => option.querySelector('.hint').textContent;
          const select = option.querySelector('select');
          const choices = select === null ? [null] : [...select.options].map((choice) => choice.value);
          return choices.map((choice) => {
            if (choice !== null) {
              select.value = choice;
              select.dispatchEvent(new Event('change', { bubbles: true }));
            }
            return [option.querySelector('[title]').title, choice && select.selectedOptions[0].textContent, hint()];
          });
        })"""
    )
    assert len(shown) > 60
    leaks = [each for each in shown if re.search(r"\w_\w|\bnull\b|\bauto\b|\w: auto", f"{each[1]} {each[2]}")]
    assert leaks == []
    help_of = {(name, choice): hint for name, choice, hint in shown}
    assert help_of["camera", "automatic"].endswith("else no perspective.")
    assert help_of["camera", "no perspective, one scale"] == "No scales."
    assert help_of["layout", "frames, points"] == ""
    assert help_of["coordinate_order", "automatic"].startswith("X before y")
    assert "picture size" in help_of["field_of_view", None]
    headings = page.locator(".folds summary, .zone .choose").all_inner_texts()
    assert len({heading.strip().rstrip("s") for heading in headings}) == len(headings)
    expect(page.locator("[data-part=film]")).to_contain_text("mkv")


@pytest.mark.usefixtures("front")
def test_a_film_chosen_as_tracks_moves_to_the_film_input(page: Page) -> None:
    page.locator("[data-part=film]").wait_for()
    film = {"name": "clip.mp4", "mimeType": "video/mp4", "buffer": b"\0\0\0\x18ftypmp42" + bytes(64)}
    page.get_by_label("Tracks", exact=True).set_input_files(film)  # type: ignore[arg-type]
    expect(page.locator("[data-part=film]")).to_contain_text("clip.mp4")
    expect(page.locator("[data-part=tracks]")).to_be_hidden()
    expect(page.locator("[data-part=film]").get_by_role("alert")).to_be_visible(timeout=SOON)
    expect(page.get_by_text("Not read: see “Film” above.")).to_be_visible()  # nothing was submitted
    expect(page.get_by_role("button", name="Choose a mask picture")).to_be_hidden()  # nor will its first frame come
    page.get_by_role("button", name="Remove film").click()
    expect(page.get_by_text("Not read")).to_be_hidden()


@pytest.mark.usefixtures("front")
def test_tracks_chosen_as_a_film_move_to_the_tracks_input(page: Page, small: dict[str, bytes]) -> None:
    page.locator("[data-part=film]").wait_for()
    (name, data), *_ = small.items()
    file = {"name": name, "mimeType": "application/octet-stream", "buffer": data}
    page.get_by_label("Film", exact=True).set_input_files(file)  # type: ignore[arg-type]
    expect(page.locator("[data-part=tracks]")).to_contain_text(name)
    expect(page.locator("[data-part=film]")).not_to_contain_text(name)
    expect(page.get_by_text("This browser cannot decode the film")).to_be_hidden()


def test_a_finished_job_can_be_exported_shared_and_rerun(page: Page, url: str, finished: str) -> None:
    page.goto(f"{url}/#job={finished}")
    page.get_by_role("button", name="More files").click()
    page.get_by_role("button", name="Create the files").click()
    expect(page.get_by_text("Choose at least one file.")).to_be_visible()
    page.get_by_label("MDD point cache").check()
    page.get_by_label("Frames per second").fill("50")
    page.get_by_role("button", name="Create the files").click()
    with page.expect_download(timeout=SOON) as download:
        page.get_by_role("link", name="Save shapes.mdd").click(timeout=SOON)
    assert Path(download.value.path()).read_bytes()[:8] == b"\0\0\0\x0a\0\0\x01\x2c"
    assert axe_findings(page) == []

    page.get_by_role("button", name="Share", exact=True).click()
    page.get_by_role("button", name="Create a link").click()
    link = page.get_by_label("Link to this result").input_value()
    assert link.startswith(f"{url}/#share=share.{finished}.")
    guest, refused = page.context.new_page(), list[str]()
    guest.on("response", lambda response: refused.append(response.url) if response.status >= 400 else None)
    guest.goto(link)
    expect(guest.get_by_text("This is a shared, read-only result.")).to_be_visible()
    expect(guest.get_by_role("heading", name="a finished face")).to_be_visible()
    expect(guest.get_by_role("button", name="Delete")).to_be_hidden()
    expect(guest.get_by_role("button", name="Reconstruct")).to_be_hidden()
    expect(guest.locator(".view canvas").first).to_be_visible(timeout=SOON)
    assert axe_findings(guest) == []
    assert refused == [], "the page asks for nothing that the link does not allow"
    newest = httpx.get(f"{url}/v1/jobs/{finished}/shares").json()[-1]["id"]  # other links may exist
    of_the_link = page.get_by_role("listitem").filter(has_text=f"Link {newest},")
    of_the_link.get_by_role("button", name="Revoke").click()
    expect(of_the_link).to_have_count(0)
    expect(page.get_by_role("button", name="Create a link")).to_be_focused()
    guest.reload()
    expect(guest.get_by_role("heading", name="This result is no longer available")).to_be_visible()
    expect(guest.get_by_text("This share link is not valid: it was revoked")).to_be_visible()
    expect(guest.get_by_role("alert")).to_have_count(0)
    guest.close()

    page.get_by_role("button", name="Run again with other options").click()
    expect(page.get_by_text("This job reuses the inputs of “a finished face”.")).to_be_visible()
    page.get_by_text("Advanced").click()
    page.get_by_label("Method").select_option(label="temporal")
    page.get_by_label("Name (optional)").fill("again")
    page.get_by_role("button", name="Reconstruct").click()
    expect(page.get_by_role("heading", name="again")).to_be_focused()
    id = re.search(r"job=(\w+)", page.url)
    assert id is not None
    job = httpx.get(f"{url}/v1/jobs/{id[1]}").json()
    assert (job["options"]["method"], job["interpretation"]["num_points"]) == ("temporal", 300)


@pytest.mark.usefixtures("front")
def test_invalid_options_and_missing_jobs_show_their_errors(page: Page, url: str, small: dict[str, bytes]) -> None:
    choose(page, {TRACKS: small[TRACKS]})
    page.get_by_text("Lens", exact=True).click()
    page.get_by_label("Picture size").fill("wide")
    page.get_by_role("button", name="Reconstruct").click()
    place = page.locator(".option").filter(has=page.get_by_label("Picture size"))
    expect(place.get_by_role("alert").get_by_role("paragraph")).to_have_text(
        [
            "Expected width and height in pixels, such as 1920x1080, got 'wide'.",
            "Change the value, or clear the field to use the default.",
            "About this errorinvalid_option",
        ]
    )
    expect(page.get_by_text("Not submitted: see “Picture size” above.")).to_be_visible()
    page.goto(f"{url}/#job=0123456789abcdef")
    expect(page.get_by_role("heading", name="This job does not exist")).to_be_visible()
    expect(page.get_by_role("alert")).to_contain_text("There is no job '0123456789abcdef'.")
    expect(page.get_by_text("Use from code")).to_be_hidden()
    assert axe_findings(page) == []


def test_files_given_after_run_again_replace_its_inputs_and_its_name(
    page: Page, url: str, finished: str, small: dict[str, bytes]
) -> None:
    page.goto(f"{url}/#job={finished}")
    name, reused = page.get_by_label("Name (optional)"), page.get_by_text("This job reuses the inputs of")
    page.get_by_role("button", name="Run again with other options").click()
    lens = page.locator(".option").filter(has=page.get_by_label("Camera model"))
    expect(lens.locator(".hint")).to_have_text("No scales.")
    page.locator("summary", has_text="Lens").click()
    page.get_by_label("Camera model").select_option(label="automatic")
    expect(name).to_have_value("a finished face")
    page.get_by_role("button", name="Use other files").click()
    expect(page.get_by_label("Film", exact=True)).to_be_focused()
    expect(name).to_have_value("")

    page.get_by_role("button", name="Run again with other options").click()
    drop(page, {"other.npz": small[TRACKS]})
    expect(page.locator("[data-part=tracks]")).to_contain_text("other.npz")
    expect(page.locator("[data-part=tracks]")).to_be_visible()
    expect(reused).to_be_hidden()
    expect(name).to_have_value("other")
    page.get_by_role("button", name="Remove tracks").click()
    page.get_by_role("button", name="breathing sphere").click()
    expect(name).to_have_value("breathing sphere")
    page.get_by_label("Camera model").select_option(label="automatic")
    drop(page, {"mine.npz": small[TRACKS]})
    expect(name).to_have_value("mine")


@pytest.mark.usefixtures("front")
def test_an_invalid_number_in_a_closed_group_is_shown(page: Page) -> None:
    heading, rate = page.get_by_text("Files to write", exact=True), page.get_by_label("Frame rate")
    heading.click()
    rate.fill("-5")
    heading.click()
    expect(rate).to_be_hidden()
    page.get_by_role("button", name="Reconstruct").click()
    expect(rate).to_be_visible()
    expect(rate).to_be_focused()
