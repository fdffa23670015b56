"""The command line with invalid paths, missing parts and Ctrl-C: exact messages and exit codes, no traceback."""

from __future__ import annotations

import errno
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from commands import Run, words
from pliant.cli import app
from pliant.cli.exits import Exit, code_of, sentence_of
from pliant.cli.paths import output_file, output_folder
from pliant.cli.session import Session
from pliant.cli.show import details_of, find_explanation
from pliant.client import BadArgument
from pliant.schemas.problems import ProblemCode
from pliant.service.testing import InMemoryService
from pliant.worker.errors import TimedOut
from pliant.worker.processes.containment import NUMERICAL_THREADS
from serving import until
from typer.testing import CliRunner, Result

FAST = (
    "-m",
    "none",
    "-O",
    "prior=smooth+low_rank",
    "-O",
    "max_reweightings=1",
    "-O",
    "refine_rotations=false",
    "-O",
    "surface=free",
)


@pytest.fixture(scope="module")
def service() -> Iterator[InMemoryService]:
    service = InMemoryService()
    yield service
    service.stop()


@pytest.fixture
def run(service: InMemoryService, monkeypatch: pytest.MonkeyPatch) -> Run:
    service.worker.steps = 0
    for name in ("PLIANT_URL", "PLIANT_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: object) -> Result:
        return CliRunner().invoke(app, [str(each) for each in arguments], obj=Session(transport=service))

    return run


def refusal(sentence: str, code: str = "invalid_argument") -> str:
    """Return what the command line prints: the sentence, and where its code is explained."""
    return f"error {sentence} More about this error: pliant explain {code}"


NO_FILE = "expected a file, got no file at"
NO_TRACKS = (
    "FOLDER: expected track files (.csv, .h5, .hdf5, .mat, .npy, .npz, .txt), got an empty folder. Name the files."
)
NO_PICTURES = (
    "tracks: expected a file or a folder of pictures (.png, .jpg, .jpeg, .webp, .bmp), got the folder FOLDER, which has none. "
    "Give the path of a file in it."
)
A_FILE = "--output: expected a folder, got the file TRACKS. Choose another folder."
LISTED = "`pliant options` lists every option."


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("solve nofile.npz -o OUT", f"tracks: {NO_FILE} nofile.npz. Check the path."),
        ("solve FOLDER -o OUT", NO_PICTURES),
        ("submit FOLDER", NO_TRACKS),
        ("inspect FOLDER", NO_PICTURES),
        ("inspect TRACKS -g none.npz", f"ground_truth: {NO_FILE} none.npz. Check the path."),
        ("solve TRACKS -o TRACKS", A_FILE),
        ("submit TRACKS -o TRACKS", A_FILE),
        ("solve TRACKS -o TRACKS/below", "--output: TRACKS/below is below a file. Choose another folder."),
        ("up --port 0 --data TRACKS", "--data: expected a folder, got the file TRACKS. Choose another folder."),
        ("work --data TRACKS", "--data: expected a folder, got the file TRACKS. Choose another folder."),
        ("work --data TRACKS/below", "--data: TRACKS/below is below a file. Choose another folder."),
        ("track FILM -o FOLDER", "--output: expected a file, got the folder FOLDER. Give a file in it."),
        ("track FILM -o OUT/t.npz", "--output: there is no folder OUT. Create it, or choose another."),
        ("track FILM -o TRACKS", "--output: TRACKS exists already. Choose another name, or replace it with --force."),
        (
            "track FILM -o t.npz --preview TRACKS",
            "--preview: TRACKS exists already. Choose another name, or replace it with --force.",
        ),
        ("track FILM -o t.npz --region no.png", f"--region: {NO_FILE} no.png. Check the path."),
        (
            "submit TRACKS -m no.obj",
            "mesh: expected a mesh file, ROWSxCOLUMNS or none, got no file at no.obj. "
            "Check the path, or give a grid size such as 48x64.",
        ),
        ("submit TRACKS -g no.npz", f"ground_truth: {NO_FILE} no.npz. Check the path."),
        ("submit TRACKS -r no.npz", f"rotations: {NO_FILE} no.npz. Check the path."),
        ("submit FOLDER/*.npz", "FOLDER/*.npz: expected files that match, got none. Check the pattern and its quotes."),
        (
            "submit FOLDER/**.npz",
            "FOLDER/**.npz: expected a pattern of one folder's files, got **. Write a single * for any characters.",
        ),
        ("solve ~nosuchuser/x.npz -o OUT", f"tracks: {NO_FILE} ~nosuchuser/x.npz. Check the path."),
        ("submit ~/x.npz", f"tracks: {NO_FILE} ~/x.npz. Check the path."),
        (
            "solve TRACKS -m ~nosuchuser/x.obj -o OUT",
            "mesh: expected a mesh file, ROWSxCOLUMNS or none, got no file at ~nosuchuser/x.obj. "
            "Check the path, or give a grid size such as 48x64.",
        ),
        ("track FILM -o OUT --region ~nosuchuser/x.png", f"--region: {NO_FILE} ~nosuchuser/x.png. Check the path."),
        (
            "list -s done",
            "--status: expected one of queued, running, cancelling, succeeded, failed, cancelled, got 'done'.",
        ),
        ("submit TRACKS -O loss", f"--option: expected NAME=VALUE, got 'loss'. {LISTED}"),
        (
            "solve TRACKS -o OUT -O frobnicate=1",
            f"options.frobnicate: expected the name of an option, got the unknown name 'frobnicate'. {LISTED}",
        ),
        (
            "submit TRACKS -O los=l1",
            f"options.los: expected the name of an option, got the unknown name 'los'. Did you mean loss? {LISTED}",
        ),
        (
            "solve TRACKS -o OUT -O focal_length=800",
            "options.focal_length: expected the name of an option, got the unknown name 'focal_length'. Did you mean focal? "
            f"{LISTED}",
        ),
    ],
)
def test_bad_paths_or_options_are_errors(run: Run, tracks: Path, tmp_path: Path, arguments: str, sentence: str) -> None:
    (tmp_path / "folder").mkdir()
    names = {
        "FILM": str(tracks),
        "TRACKS": str(tracks),
        "FOLDER": str(tmp_path / "folder"),
        "OUT": str(tmp_path / "out"),
    }

    def filled(text: str) -> str:
        for name, path in names.items():
            text = text.replace(name, path)
        return text

    ran = run(*map(filled, arguments.split()))
    assert (ran.exit_code, ran.stdout) == (Exit.REFUSED, "")
    code = "unknown_option" if sentence.startswith("options.") else "invalid_argument"
    assert words(ran) == refusal(filled(sentence), code)


def test_unwritable_folders_are_rejected(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Permissions do not restrict root, so the system calls are replaced."""
    folder = tmp_path / "locked"
    folder.mkdir()
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(BadArgument, match=rf"the folder {folder} is not writable\. Choose another folder\."):
        output_folder(folder, force=False)
    with pytest.raises(BadArgument, match=rf"--output: the folder {folder} is not writable\. Choose another folder\."):
        output_file(folder / "tracks.npz", "--output", force=True)
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    with pytest.raises(BadArgument, match=r"cannot create .*: Permission denied"):
        output_folder(tmp_path / "new", force=False)


def test_unreadable_files_are_rejected(run: Run, tracks: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pliant.client.input_files.os.access", lambda *_: False)
    ran = run("solve", tracks, "-o", tmp_path / "out")
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == refusal(f"tracks: the file {tracks} cannot be read. Change its permissions.")


def test_system_errors_have_a_message_and_defects_a_traceback(tmp_path: Path) -> None:
    full = OSError(28, "No space left on device")
    assert (code_of(full), sentence_of(full)) == (Exit.REFUSED, "No space left on device.")
    with pytest.raises(OSError, match="Is a directory") as caught:
        tmp_path.open("wb")
    assert code_of(caught.value) == Exit.REFUSED
    assert sentence_of(caught.value) == f"{tmp_path}: Is a directory."
    assert code_of(TimedOut(1.0)) == Exit.FAILED
    assert code_of(ZeroDivisionError()) is None
    assert code_of(OSError("no file is named")) is None


def test_existing_results_are_kept_unless_forced(run: Run, tracks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.json").write_text("mine")
    sentence = refusal(
        f"--output: {out} already holds report.json. Choose another folder, or replace the files with --force."
    )
    for command in (("solve", tracks, "-o", out), ("submit", tracks, "-o", out)):
        ran = run(*command)
        assert (ran.exit_code, words(ran)) == (Exit.REFUSED, sentence)
    assert (out / "report.json").read_text() == "mine"
    assert run("submit", tracks, "-m", "none", "-o", out, "--force", "--id", "forced").exit_code == 0
    assert json.loads((out / "report.json").read_text())["outcome"] == "converged"
    assert run("result", "forced", "-o", out).exit_code == 0, "the same files are no conflict"
    (out / "shapes.npz").write_text("changed")
    ran = run("result", "forced", "-o", out)
    assert ran.exit_code == Exit.REFUSED
    assert "already holds shapes.npz" in words(ran)
    assert run("result", "forced", "-o", out, "--force").exit_code == 0
    assert np.load(out / "shapes.npz")["shapes"].shape == (5, 12, 3)


def test_an_existing_glb_file_is_kept_unless_forced(run: Run, tracks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "shapes.glb").write_text("mine")
    ran = run("submit", tracks, "-m", "2x6", "--id", "glb", "-o", out)
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == "Job glb " + refusal(
        f"--output: {out} already holds shapes.glb. Choose another folder, or replace the files with --force."
    )
    assert (out / "shapes.glb").read_text() == "mine"
    assert run("result", "glb", "-o", out, "--force").exit_code == 0
    assert (out / "shapes.glb").read_bytes().startswith(b"glTF")


@pytest.mark.parametrize(
    ("given", "existing", "more"),
    [("tracks.npz", "shapes.glb", ()), ("film.gif", "contact_sheet.jpg", ()), ("tracks.npz", "shapes.mdd", ("-O", 'outputs=["mdd"]'))],
)  # fmt: skip
def test_solve_does_not_replace_existing_files(
    run: Run, tracks: Path, tmp_path: Path, given: str, existing: str, more: tuple[str, ...]
) -> None:
    (tmp_path / "film.gif").write_bytes(b"GIF89a")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / existing).write_text("mine")
    ran = run("solve", tracks.with_name(given), "-o", tmp_path / "out", *more)
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == refusal(
        f"--output: {tmp_path / 'out'} already holds {existing}. Choose another folder, or replace the files with --force."
    )
    assert [path.name for path in (tmp_path / "out").iterdir()] == [existing]


def test_solve_leaves_files_that_it_does_not_write(run: Run, tracks: Path) -> None:
    for name in ("shapes.mdd", "contact_sheet.jpg"):
        (tracks.parent / name).write_text("mine")
    ran = run("solve", tracks, "-o", tracks.parent, "-O", 'outputs=["mat"]', *FAST)
    assert ran.exit_code == 0, ran.output
    assert (tracks.parent / "shapes.mdd").read_text() == "mine"
    assert (
        f"warning {tracks.parent} also contains shapes.mdd, contact_sheet.jpg, not written by this command."
        in words(ran)
    )


def test_demo_replaces_files_in_a_named_folder_only_if_forced(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def render(_: object, folder: Path) -> None:
        raise BadArgument(f"rendered into {folder}")

    monkeypatch.setattr(importlib.import_module("pliant.cli.demo"), "render", render)
    monkeypatch.chdir(tmp_path)
    for folder in ("mine", "demo-output"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tracks.npz").write_text("mine")
    assert json.loads(run("demo", "--json", "-o", "mine").stderr)["detail"] == (
        "--output: mine already holds tracks.npz. Choose another folder, or replace the files with --force."
    )
    for more, folder in ((["-o", "mine", "--force"], "mine"), ([], "demo-output"), (["-o", "new"], "new")):
        ran = run("demo", "--json", *more)
        assert json.loads(ran.stderr)["detail"] == f"rendered into {folder}", more


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_demo_ends_with_its_service_when_its_terminal_or_process_is_ended(
    tmp_path: Path, number: signal.Signals
) -> None:
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip("these tests run under nohup")
    (tmp_path / "tmp").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "tmp")}
    command = [sys.executable, "-m", "pliant.cli", "demo", "--small", "--json"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as demo:
        until(lambda: list((tmp_path / "tmp").glob("pliant-demo-*/data/*")) != [], seconds=60)
        demo.send_signal(number)
        assert demo.wait(60) == Exit.INTERRUPTED
    assert list((tmp_path / "tmp").glob("pliant-demo-*")) == []  # the service has ended, and its data are removed


def test_jobs_can_be_given_by_id_prefix_or_as_the_last_one(run: Run, tracks: Path) -> None:
    for name in ("apple-1", "apple-2", "banana-1"):
        assert run("submit", tracks, "-m", "none", "--id", name).exit_code == 0
    assert json.loads(run("status", "ban", "--json").stdout)["id"] == "banana-1"
    assert json.loads(run("watch", "@last", "--json").stdout)["id"] == "banana-1"
    ran = run("status", "apple")
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == refusal("apple: 2 jobs begin with it (apple-2, apple-1). Give more characters.")
    assert run("log", "cherry").exit_code == Exit.NOT_FOUND
    run("watch", "apple-1")
    ran = run("delete", "apple-1", "cherry")
    assert ran.exit_code == Exit.NOT_FOUND
    assert run("status", "apple-1").exit_code == 0, "nothing is deleted unless every id is valid"
    assert words(run("delete", "apple-1")) == "Deleted: apple-1"
    empty = CliRunner().invoke(app, ["status", "@last"], obj=Session(transport=InMemoryService()))
    assert empty.exit_code == Exit.NOT_FOUND
    assert words(empty) == (
        "error @last: there are no jobs yet. Submit one with `pliant submit FILE`, a track file or a film. "
        "More about this error: http://127.0.0.1:8000/errors/unknown_job"
    )


def test_the_id_is_printed_before_waiting(run: Run, tracks: Path, service: InMemoryService) -> None:
    service.worker.steps = math.inf
    ran = run("submit", tracks, "-m", "none", "--id", "early", "--wait", "--timeout", "3")
    assert ran.exit_code == Exit.TIMEOUT
    assert words(ran).startswith("Job early")
    assert (
        "The timeout of 3 s passed during the wait for job early. Job early continues: `pliant watch early` follows it"
        in words(ran)
    )
    run("cancel", "early")


def test_progress_lines_are_printed_without_a_terminal(
    run: Run, tracks: Path, service: InMemoryService, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.worker.steps = 40
    monkeypatch.setattr(importlib.import_module("pliant.cli.jobs"), "LINE_EVERY", 0.1)
    ran = run("submit", tracks, "-m", "none", "--wait")
    assert ran.exit_code == 0
    lines = [line for line in ran.stderr.splitlines() if " s: " in line]
    assert len(lines) >= 3
    assert any("loading" in line or "reweight" in line or "running" in line for line in lines)


@pytest.mark.parametrize("command", [["up"], ["work"], ["token", "list"], ["demo"], ["fsck"]], ids=" ".join)
def test_server_commands_say_what_to_install(
    command: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rq", None)
    ran = CliRunner().invoke(app, command)
    name = {"token": "pliant token"}.get(command[0], f"pliant {' '.join(command)}")
    assert ran.exit_code == Exit.UNHEALTHY
    assert words(ran) == refusal(
        f"{name} needs the service, which is not installed: pip install '.[server]' in Pliant's source folder",
        "missing_extra",
    )


@pytest.mark.parametrize("absent", ["prometheus_client", "pythonjsonlogger"])
def test_server_commands_need_every_module_that_the_service_imports(
    absent: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, absent, None)
    ran = CliRunner().invoke(app, ["up"])
    assert ran.exit_code == Exit.UNHEALTHY
    assert "pliant up needs the service, which is not installed" in words(ran)


@pytest.mark.parametrize(
    "command", [["fsck"], ["backup", "copy"], ["token", "list"], ["token", "revoke", "t1"]], ids=" ".join
)
def test_commands_reject_a_missing_installation_and_create_nothing(
    command: list[str], run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PLIANT_REDIS_URL", raising=False)
    (tmp_path / "empty").mkdir()
    for name, what in (("new", "which does not exist"), ("empty", "which has none of its folders")):
        ran = run(*command, "--data", name)
        assert ran.exit_code == Exit.REFUSED
        assert words(ran) == refusal(
            f"--data: expected the directory of an installation, got {name}, {what}. Give the one that `pliant up` uses."
        )
    assert [each.name for each in tmp_path.rglob("*")] == ["empty"]


@pytest.mark.parametrize("folder", ["blobs", "uploads"])
def test_fsck_refuses_folders_that_this_user_cannot_read(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: str
) -> None:
    """Without their right to read, it called the blob store unavailable, and took folders of uploads for empty."""
    closed = tmp_path / folder
    closed.mkdir()
    monkeypatch.setattr("os.access", lambda path, mode: path != closed)
    ran = run("fsck", "--data", str(tmp_path))
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == refusal(
        f"--data: expected folders that this user can read, got {closed}, which it cannot. Run the command as the user that runs "
        "Pliant, for example with `sudo -u pliant`."
    )


def test_fsck_points_to_the_doctor_if_a_server_does_not_answer(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def advice() -> str:
        ran = run("fsck", "--data", str(tmp_path), "--json")
        assert ran.exit_code == Exit.UNHEALTHY
        return str(json.loads(ran.stdout)[0]["advice"])

    (tmp_path / "valkey").mkdir()
    assert advice() == "Start `pliant up` on this directory, then check again."
    monkeypatch.setenv("PLIANT_REDIS_URL", "redis://127.0.0.1:9")
    assert advice() == "`pliant doctor` checks the stores."


def test_an_unknown_scope_is_refused_before_the_installation_is_opened(run: Run, tmp_path: Path) -> None:
    ran = run("token", "create", "ada", "--scope", "root", "--data", str(tmp_path / "data"))
    assert ran.exit_code == Exit.REFUSED
    assert words(ran) == refusal("--scope: expected read, submit or admin, got 'root'.")
    assert not (tmp_path / "data").exists()


def test_a_missing_server_module_says_what_to_install(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("No module named 'redis'", name="redis")

    monkeypatch.setattr("pliant.client._sync.client.Client.list", broken)
    ran = run("list")
    assert ran.exit_code == Exit.UNHEALTHY
    assert "pip install '.[server]'" in words(ran)


def interrupted(command: list[str], after: str, *, cwd: Path) -> tuple[int, str]:
    """Run the command line, press Ctrl-C once it has printed some text, and return its exit code and standard error."""
    started = subprocess.Popen(
        [sys.executable, "-m", "pliant.cli", *command],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert started.stdout is not None
    printed = ""
    while after not in printed:
        piece = started.stdout.readline()
        assert piece, printed
        printed += piece
    time.sleep(0.2)
    started.send_signal(signal.SIGINT)
    printed += started.stdout.read()
    started.stdout.close()
    return started.wait(30), " ".join(printed.split())


LOADED = """
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watch())
sys.argv = ["pliant", *sys.argv[1:]]
from pliant.cli import main
main()
"""


@pytest.mark.parametrize(
    "command", [("solve", "none.npz", "-o", "out"), ("track", "none.mp4", "-o", "tracks.npz", "--region", "none.png")]
)
def test_numerical_libraries_are_loaded_after_their_threads_are_limited(
    tmp_path: Path, command: tuple[str, ...]
) -> None:
    """They read their variables once; more threads than the solver's own slow down a busy machine many times over."""
    environment = {name: value for name, value in os.environ.items() if name not in NUMERICAL_THREADS}
    ran = subprocess.run(
        [sys.executable, "-c", LOADED, *command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False
    )  # fmt: skip
    assert (ran.returncode, ran.stdout) == (Exit.REFUSED, "1\n"), ran.stderr


@pytest.mark.slow
def test_ctrl_c_while_solving_leaves_no_output(tmp_path: Path) -> None:
    from pliant.solver.gallery import face

    np.savez(tmp_path / "face.npz", tracks=face(60, 3000).tracks.points)
    code, printed = interrupted(["solve", "face.npz", "-o", "out"], "frames ×", cwd=tmp_path)
    assert (code, printed.rpartition("error ")[2]) == (Exit.INTERRUPTED, "Interrupted.")
    assert "Traceback" not in printed
    assert not (tmp_path / "out").exists()


STOPPED = """
import os, signal, sys
name, number = sys.argv[1], int(sys.argv[2])
class Watch:
    def find_spec(self, found, path=None, target=None):
        if found == name:
            print("stopping at", found)
            os.kill(os.getpid(), number)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Watch())
sys.argv = ["pliant", *sys.argv[3:]]
from pliant.cli import main
main()
"""


@pytest.mark.parametrize(
    ("imported", "number"),
    [
        ("typer", signal.SIGINT),
        ("pliant.worker.execution.pipeline", signal.SIGTERM),
        ("pliant.worker.execution.pipeline", signal.SIGHUP),
    ],
    ids=["Ctrl-C at the start", "SIGTERM while solving", "SIGHUP while solving"],
)
def test_solve_ends_in_order_at_any_time(tmp_path: Path, tracks: Path, imported: str, number: int) -> None:
    if signal.getsignal(number) == signal.SIG_IGN and number != signal.SIGINT:
        pytest.skip("these tests run under nohup")
    command = [sys.executable, "-c", STOPPED, imported, str(int(number)), "solve", str(tracks), "-o", "out"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert (ran.returncode, ran.stderr.rpartition("\n")[0]) == (Exit.INTERRUPTED, "error Interrupted.")
    assert f"stopping at {imported}" in ran.stdout
    assert not (tmp_path / "out").exists()


def test_ctrl_c_while_waiting_prints_how_to_resume(
    run: Run, tracks: Path, service: InMemoryService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    service.worker.steps = math.inf
    assert run("submit", tracks, "-m", "none", "--id", "slow").exit_code == 0
    monkeypatch.setattr("pliant.client._sync.client.Client.wait", interrupt)
    ran = run("watch", "slow")
    assert ran.exit_code == Exit.INTERRUPTED
    assert (
        words(ran)
        == "error Interrupted. Job slow continues: `pliant watch slow` follows it, `pliant cancel slow` stops it."
    )
    run("cancel", "slow")


def test_explain_prints_cause_and_remedy_of_an_error_code(run: Run) -> None:
    code = ProblemCode.TOO_FEW_FRAMES
    assert run("explain", "too_few_frames").stdout == (
        f"{code.heading}: too_few_frames (HTTP status 422)\n{code.cause}\nWhat to do: {code.remedy}\n"
    )
    assert run("explain", "unusable_path").stdout.startswith("Unusable path: unusable_path\n")
    assert json.loads(run("explain", "too_few_frames", "--json").stdout) == [
        {"code": code, "status": 422, "title": code.heading, "cause": code.cause, "remedy": code.remedy}
    ]
    assert [line.split()[0] for line in run("explain").stdout.splitlines()] == list(ProblemCode)
    ran = run("explain", "too_few_frame")
    assert (ran.exit_code, words(ran)) == (
        Exit.REFUSED,
        refusal(
            "CODE: there is no error code 'too_few_frame'. Did you mean too_few_frames? `pliant explain` lists all codes."
        ),
    )


def test_errors_end_with_where_they_are_explained(run: Run, tracks: Path, tmp_path: Path) -> None:
    """Local errors name `pliant explain`, errors of a service its page; JSON has a field for it."""
    np.savez(tmp_path / "short.npz", tracks=np.ones((2, 9, 2)))
    sentence = "error tracks: expected at least 3 frames, got 2. Track a longer clip. More about this error: "
    ran = run("inspect", tmp_path / "short.npz")
    assert words(ran) == f"{sentence}pliant explain too_few_frames"
    ran = run("submit", tmp_path / "short.npz", "--url", "http://pliant.test/")
    assert words(ran) == f"{sentence}http://pliant.test/errors/too_few_frames"
    document = json.loads(run("submit", tmp_path / "short.npz", "--json").stderr)
    assert document["explained_at"] == "http://127.0.0.1:8000/errors/too_few_frames"
    full = OSError(28, "No space left on device")
    assert find_explanation(details_of(full), None) == "pliant explain unusable_path"
    assert find_explanation(details_of(KeyboardInterrupt()), None) is None, "no refusal"
    ran = run("solve", tracks, "--mask", "m.png")
    assert (ran.exit_code, "No such option: --mask (Possible options: --region)" in words(ran)) == (Exit.USAGE, True)
    ran = run("solve", tracks, "--image-size", "320x240")
    assert "It is an option of the reconstruction: -O image_size=VALUE" in words(ran)
    ran = run("solve", tracks, "--focal-length", "800")
    assert "An option of the reconstruction is given as -O focal=VALUE" in words(ran)
    ran = run("up", "--loss", "l1")
    assert "-O" not in words(ran), "it has no such options"
    ran = run("solve", tracks, "--frobnicate")
    assert ran.exit_code == Exit.USAGE
    assert "Try 'pliant solve --help' for help." in words(ran), "usage errors lead to the reference of the command"


def test_a_full_disk_of_a_backup_is_named(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(settings: object, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pliant.worker.maintenance.backup.write_backup", full)
    monkeypatch.setattr("pliant.worker.processes.valkey.attended", lambda settings: nullcontext())
    (tmp_path / "data" / "valkey").mkdir(parents=True)
    ran = run("backup", str(tmp_path / "copy"), "--data", str(tmp_path / "data"))
    assert ran.exit_code != 0
    assert f"{tmp_path / 'copy'}: No space left on device." in words(ran)


def test_restoring_what_is_no_backup_creates_nothing(tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["restore", str(tmp_path / "missing"), "--data", str(tmp_path / "data")])
    assert ran.exit_code != 0
    assert "holds no backup" in ran.output
    assert list(tmp_path.iterdir()) == []
