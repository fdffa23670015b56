"""Commands end with the verdict, never with "Converged" alone."""

from __future__ import annotations

import io
import json
import re
from datetime import UTC, datetime
from pathlib import Path

import pytest
from pliant.cli.commands.batch import Batch, Row, describe_verdict
from pliant.cli.demo import MEANINGS, report
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.cli.show import METRIC_MEANINGS, metrics_table, print_json, show_fault, show_job, show_jobs, verdict_lines
from pliant.cli.solve import show_finished
from pliant.client.errors import JobFailed
from pliant.schemas.job import Interpretation, Job, Progress, Status
from pliant.schemas.options import Options
from pliant.worker.jobs.finished import Finished

REASON = "The estimated cameras turn by only 9°; depth needs 20° or more."
TRUST = "Expected error about 4 % of the object's size; depth rests on 9° of turn."
LAST = ["Use with care  " + TRUST + " Converged.", "  " + REASON]


def finished(**changed: object) -> Finished:
    given = {
        "metrics": {"reprojection_median": 0.5}, "outcome": "converged", "sentence": "Converged.", "warnings": (), "artifacts": (),
        "verdict": "with_care", "verdict_reasons": (REASON,), "trust_sentence": TRUST,
    }  # fmt: skip
    return Finished(**(given | changed))  # type: ignore[arg-type]


def job(**changed: object) -> Job:
    interpretation = Interpretation(
        num_frames=3, num_points=4, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    given = {
        "id": "job", "status": Status.SUCCEEDED, "created_at": datetime.now(UTC), "options": Options(), "outcome": "converged",
        "interpretation": interpretation, "sentence": "Converged.",
    }  # fmt: skip
    return Job.model_validate(given | changed)


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


def test_solve_ends_with_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    show_finished(finished(), Path("out"), as_json=False)
    assert capsys.readouterr().out.splitlines()[-2:] == LAST
    show_finished(finished(), Path("out"), as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert (printed["verdict"], printed["verdict_reasons"], printed["trust_sentence"]) == ("with_care", [REASON], TRUST)


def test_a_verdict_without_an_error_estimate_says_so_first(capsys: pytest.CaptureFixture[str]) -> None:
    sentence = "The error is not estimated; depth rests on 41° of turn."
    (line,) = verdict_lines(finished(verdict="good", verdict_reasons=(), trust_sentence=sentence))
    assert line.plain.startswith("Good, error not estimated  Depth rests on 41° of turn. ")
    assert not any("green" in str(span.style) for span in line.spans)
    good = job(verdict="good", trust_sentence=sentence)
    show_jobs([good], as_json=False)
    assert "Good, error not estimated" in " ".join(capsys.readouterr().out.split())
    assert describe_verdict(good).plain == "Good, error not estimated"


def test_solve_states_the_camera(capsys: pytest.CaptureFixture[str]) -> None:
    lens = "Perspective camera, focal length 901 px ± 12, horizontal field of view 70.8° ± 0.72°."
    show_finished(finished(camera_sentence=lens), Path("out"), as_json=False)
    assert capsys.readouterr().out.splitlines()[-3:] == [lens, *LAST]
    show_finished(finished(camera_sentence=lens), Path("out"), as_json=True)
    assert json.loads(capsys.readouterr().out)["camera_sentence"] == lens


def test_a_failed_job_is_shown_with_the_warnings_about_its_film(capsys: pytest.CaptureFixture[str]) -> None:
    cut = "The film has a cut (at frame 10)."
    error = {
        "code": "tracks_lost",
        "status": 422,
        "title": "Lost",
        "detail": "No points.",
        "type": "/errors/tracks_lost",
    }
    fault = JobFailed(job(status=Status.FAILED, error=error, warnings=[cut]))
    show_fault(fault, str(fault), Exit.FAILED, as_json=False)
    warned, failed, _ = capsys.readouterr().err.splitlines()
    assert (warned, failed) == (f"warning {cut}", f"error {fault}")


def test_shown_jobs_end_with_the_verdict_and_old_ones_with_the_outcome(capsys: pytest.CaptureFixture[str]) -> None:
    show_job(job(verdict="with_care", verdict_reasons=[REASON], trust_sentence=TRUST), as_json=False)
    shown = capsys.readouterr().out
    assert shown.splitlines()[-2:] == LAST
    assert shown.count("Converged") == 1
    show_job(job(), as_json=False)
    shown = capsys.readouterr().out
    assert "Converged." in shown
    assert "Good" not in shown
    assert verdict_lines(job()) == []


def test_the_job_list_shows_verdicts(capsys: pytest.CaptureFixture[str]) -> None:
    show_jobs([job(verdict="do_not_use"), job()], as_json=False)
    heading, bad, old = capsys.readouterr().out.splitlines()
    assert "verdict" in heading
    assert "Do not use" in bad
    assert old.split()[:2] == ["job", "succeeded"]


def test_the_demo_explains_its_metrics(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    judged = job(verdict="with_care", verdict_reasons=[REASON], trust_sentence=TRUST)
    report(judged, dict.fromkeys(MEANINGS, 0.04), {}, good=True, url=None, as_json=False)
    rows = capsys.readouterr().out.splitlines()
    assert [row for row in rows if row in LAST] == LAST
    for name, meaning in MEANINGS.items():
        (row,) = [line for line in rows if name in line.split()]
        assert meaning in row
        assert "0.04" in row


def test_headline_error_and_metric_meanings_match_the_web_page() -> None:
    headline = next(iter(METRIC_MEANINGS))
    assert headline == next(iter(MEANINGS)) == "e3d_frame_scaled"
    assert MEANINGS[headline].startswith(METRIC_MEANINGS[headline])
    page = (Path(__file__).parents[2] / "service" / "web" / "src" / "results.ts").read_text()
    words = dict(re.findall(r'^  (\w+): \["(?:[^"]*)", "([^"]*)"\],$', page, flags=re.MULTILINE))
    assert list(words) == list(METRIC_MEANINGS)
    spoken = {name: meaning.replace("\\u00a0", " ") for name, meaning in words.items()}  # no line break before %
    assert {name: meaning.removeprefix("3-D error: ") for name, meaning in METRIC_MEANINGS.items()} == spoken


def test_the_metrics_table_starts_with_the_headline_error() -> None:
    table = metrics_table(
        {"of_a_newer_service": 1.0, "reprojection_rms": 0.5, "e3d_sequence": 0.2, "e3d_frame_scaled": 0.1}
    )
    names, _, meanings = (list(column.cells) for column in table.columns)
    assert names == ["e3d_frame_scaled", "e3d_sequence", "reprojection_rms", "of_a_newer_service"]
    assert meanings == [*(METRIC_MEANINGS[name] for name in names[:3]), ""]


def test_the_job_list_is_complete_at_80_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    named = job(id="e2efed37cfcf5352891c", name="talking head", verdict="with_care")
    progress = Progress(stage="reweight", fraction=0.5, updated_at=datetime.now(UTC))
    running = named.model_copy(update={"status": Status.RUNNING, "verdict": None, "progress": progress})
    show_jobs([named, running], as_json=False)
    printed = capsys.readouterr().out
    assert "…" not in printed
    day = f"{named.created_at.astimezone():%Y-%m-%d %H:%M}"
    assert re.search(rf"^{named.id} succeeded +{day} Use with ", printed, flags=re.MULTILINE), printed
    assert re.search(rf"^{named.id} running 50% {day} ", printed, flags=re.MULTILINE), printed
    assert all(word in printed.split() for word in ("care", "talking", "head"))
    assert max(len(line) for line in printed.splitlines()) <= 80


@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_ids_are_not_truncated_on_narrow_terminals(
    columns: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    known = job(id="e2efed37cfcf5352891c", name="a name that is long", verdict="with_care")
    show_jobs([known], as_json=False)
    assert known.id in capsys.readouterr().out
    batch = Batch(
        files=[],
        shared={},
        options={},
        key="",
        priority="normal",
        timeout=None,
        output=None,
        force=False,
        wait=True,
        url="http://pliant.test",
        session=Session(),
    )
    batch.rows = [Row(Path("a file with a long name.npz"), known)]
    batch.show(as_json=False)
    assert known.id in capsys.readouterr().out


def test_the_batch_table_shows_each_verdict_and_its_first_reason(capsys: pytest.CaptureFixture[str]) -> None:
    batch = Batch(
        files=[], shared={}, options={}, key="", priority="normal", timeout=None, output=None, force=False, wait=True,
        url="http://pliant.test", session=Session(),
    )  # fmt: skip
    verdicts = {
        "with_care": [REASON, "A second reason."],
        "good": [],
        "do_not_use": ["The residual is large."],
        None: [],
    }
    batch.rows = [
        Row(Path(f"{verdict}.npz"), job(verdict=verdict, verdict_reasons=reasons))
        for verdict, reasons in verdicts.items()
    ]
    batch.show(as_json=False)
    rows = [[cell.strip() for cell in line.split("│")] for line in capsys.readouterr().out.splitlines() if "│" in line]
    assert [row[4] for row in rows] == ["Use with care", REASON, "Good", "Do not use", "The residual is large.", ""]


def test_json_escapes_what_the_output_cannot_encode(monkeypatch: pytest.MonkeyPatch) -> None:
    for encoding, path in (("utf-8", "out\udcff"), ("ascii", "Gänge")):
        screen = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr("sys.stdout", screen)
        print_json({"path": path})
        screen.flush()
        assert json.loads(screen.buffer.getvalue()) == {"path": path}
