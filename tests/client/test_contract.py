"""The contract of every Pliant service, through both clients: in memory and over HTTP."""

from __future__ import annotations

import asyncio
import math
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from blocking import Blocking
from long_jobs import long_request
from pliant.client import (
    AsyncClient,
    AsyncRemoteJob,
    AsyncResult,
    BadArgument,
    Client,
    InvalidRequest,
    Job,
    JobCancelled,
    JobFailed,
    NotAllowedNow,
    NotAuthorized,
    NotFound,
    Problem,
    Retry,
    Status,
)
from pliant.schemas.job import Interpretation
from pliant.service.testing import InMemoryService

PATIENT = Retry(shortest_pause=0.01, poll_interval=0.02)
FAST = {
    "prior": "smooth+low_rank", "max_reweightings": 2, "tolerance": 0.1, "refine_rotations": False, "surface": "free",
    "camera": "orthographic",
}  # fmt: skip
"""Options with which a tiny job ends within a second."""


def moving_points(frames: int = 6, count: int = 16) -> np.ndarray:
    rng = np.random.default_rng(3)
    surface = rng.normal(size=(count, 3))
    angles = np.linspace(0, 1, frames)
    turns = np.stack([np.stack([np.cos(angles), 0 * angles, np.sin(angles)], 1), np.tile([0, 1.0, 0], (frames, 1))], 1)
    return 100 + 20 * np.einsum("fij,pj->fpi", turns, surface)


Door = tuple[str, str]
"""Which client, and which server it uses."""

DOORS: list[Door] = [("sync", "double"), ("async", "double"), ("async", "service")]
EVERY_DOOR = pytest.mark.parametrize("door", [*DOORS, ("sync", "service")], indirect=True, ids="-".join)
"""The synchronous client is generated from the asynchronous one, so only tests that depend on the transport run it on the service."""


@pytest.fixture(params=DOORS, ids="-".join)
def door(request: pytest.FixtureRequest) -> Door:
    return cast(Door, request.param)


@pytest.fixture
def kind(door: Door) -> str:
    return door[0]


@pytest.fixture
def asked(request: pytest.FixtureRequest, door: Door) -> dict[str, Any]:
    """Arguments of a client: the in-memory double, or the address of a real service."""
    if door[1] == "double":
        return {"url": "http://pliant.test", "transport": InMemoryService(), "retries": PATIENT}
    return {"url": request.getfixturevalue("service_url"), "retries": PATIENT}


@contextmanager
def opened(kind: str, asked: dict[str, Any]) -> Iterator[Client]:
    """Open a client of either kind; the asynchronous one is wrapped to block, so that both share the tests."""
    if kind == "sync":
        with Client(**asked) as client:
            yield client
        return
    with asyncio.Runner() as runner:
        client = Blocking(AsyncClient(**asked), runner, (AsyncClient, AsyncRemoteJob, AsyncResult))
        yield cast(Client, client)
        client.close()


@pytest.fixture
def client(kind: str, asked: dict[str, Any]) -> Iterator[Client]:
    with opened(kind, asked) as client:
        yield client


@EVERY_DOOR
def test_submit_wait_shapes_is_one_line(client: Client) -> None:
    shapes = client.submit(moving_points(), options=FAST).wait(timeout=60).shapes
    assert shapes.shape == (6, 16, 3)
    np.testing.assert_allclose(shapes.mean(axis=1), 0, atol=1e-9)


@EVERY_DOOR
def test_a_result_holds_arrays_report_and_job(client: Client, tmp_path: Path) -> None:
    updates: list[Job] = []
    sent: list[tuple[int, int]] = []
    points = moving_points()
    points[2, 3] = np.nan
    hidden = np.isnan(points).any(axis=2)
    job = client.submit(points, options=FAST, name="one", on_upload=lambda *now: sent.append(now))
    result = job.wait(timeout=60, folder=tmp_path / "kept", on_progress=updates.append)
    np.testing.assert_allclose(
        result.rotations @ result.rotations.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-9
    )
    assert result.report["outcome"] in ("converged", "max_reweightings")
    assert job.record.interpretation.estimate is not None
    assert result.report["interpretation"]["estimate"] == job.record.interpretation.estimate.model_dump(mode="json")
    assert result.job.name == "one"
    assert updates[-1].status is Status.SUCCEEDED
    assert job.status is Status.SUCCEEDED
    assert repr(job).endswith(f"RemoteJob {job.id} succeeded>")
    assert sent[-1][0] == sent[-1][1] > 0
    assert result.job.status is Status.SUCCEEDED
    assert len(client.log(result.job.id).splitlines()) >= 2
    probability, weights = result.inlier_probability, result.arrays["weights"]
    assert probability is not None
    assert probability.shape == weights.shape == (6, 16)
    np.testing.assert_array_equal(np.isnan(probability), hidden)
    assert ((probability >= 0) & (probability <= 1) | hidden).all()
    assert (weights[hidden] == 0).all()
    assert result.save_glb(tmp_path / "deep" / "it.glb").read_bytes()[:4] == b"glTF"
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"shapes.npz", "report.json", "shapes.glb"}
    everything = result.download(tmp_path / "all")
    assert set(everything) == {artifact.name for artifact in result.job.artifacts}


def test_results_keep_point_names_and_the_job_name(client: Client, tmp_path: Path) -> None:
    heads = [f"{part}_{axis}" for part in ("Nose", "chin", "brow", "tip") for axis in "xy"]
    rows = np.random.default_rng(0).uniform(0, 100, (1, 8)) + np.arange(5)[:, None]
    text = "\n".join(",".join(map(str, row)) for row in [heads, *rows.tolist()])
    (tmp_path / "pose.csv").write_text(text)
    result = client.submit(tmp_path / "pose.csv", mesh="none", options=FAST, name="a pose").wait(timeout=60)
    assert result.point_names == ("Nose", "chin", "brow", "tip")
    assert result.report["name"] == "a pose"
    assert '"name":"a pose"' in result.save_glb(tmp_path / "it.glb").read_bytes().decode("utf-8", "replace")
    assert client.submit(moving_points(), options=FAST).wait(timeout=60).point_names is None


def test_rejected_requests_raise_typed_errors_with_the_services_message(client: Client) -> None:
    with pytest.raises(InvalidRequest) as caught:
        client.submit(np.ones((2, 9, 2)), name="too-short")
    assert caught.value.code == "too_few_frames"
    assert caught.value.status == 422
    assert caught.value.problem.field == "tracks"
    assert str(caught.value) == caught.value.problem.detail
    assert "too-short" not in [job.record.name for job in client.list()]


def test_inspecting_returns_the_interpretation_without_creating_a_job(client: Client) -> None:
    points = moving_points()
    points[2, 3] = np.nan
    before = [job.id for job in client.list()]
    interpretation = client.inspect(points, mesh="none", rotations=np.tile(np.eye(3), (6, 1, 1)), options=FAST)
    assert [job.id for job in client.list()] == before
    assert (interpretation.num_frames, interpretation.num_points, interpretation.has_rotations) == (6, 16, True)
    assert interpretation.estimate is not None
    assert interpretation.estimate.memory_bytes > 0
    assert interpretation.hidden_fraction == pytest.approx(1 / (6 * 16))
    job = client.submit(points, mesh="none", rotations=np.tile(np.eye(3), (6, 1, 1)), options=FAST)
    assert job.record.interpretation == Interpretation.model_validate(
        interpretation.model_dump(exclude={"sample", "first_frame"})
    )
    assert len(interpretation.sample) == 6
    with pytest.raises(InvalidRequest) as caught:
        client.inspect(np.ones((2, 9, 2)))
    assert caught.value.code == "too_few_frames"


def test_known_cameras_may_have_scales(client: Client) -> None:
    cameras = {"rotations": np.tile(np.eye(3), (6, 1, 1)), "scales": np.full(6, 2.0)}
    assert client.inspect(moving_points(), rotations=cameras).has_rotations
    with pytest.raises(InvalidRequest, match="beside given scales"):
        client.inspect(moving_points(), rotations=cameras, options={"camera": "orthographic"})


def test_a_dictionary_may_name_the_points(client: Client) -> None:
    named = {"tracks": moving_points(), "point_names": [f"marker {number}" for number in range(16)]}
    assert any("names its 16 points: marker 0" in note for note in client.inspect(named).notes)


def test_a_key_also_counts_beside_an_id(client: Client) -> None:
    key, points = secrets.token_hex(4), np.random.default_rng(7).normal(size=(5, 30, 2))
    first = client.submit(points, options=FAST, job_id=f"take-{key}", idempotency_key=key)
    assert client.submit(points, options=FAST, job_id=first.id, idempotency_key=key).id == first.id
    with pytest.raises(NotAllowedNow, match="key"):
        client.submit(points + 1, options=FAST, idempotency_key=key)


def test_the_same_idempotency_key_creates_one_job(client: Client) -> None:
    points, key = moving_points(), secrets.token_hex()
    first = client.submit(points, options=FAST, idempotency_key=key)
    assert client.submit(points, options=FAST, idempotency_key=key).id == first.id
    assert client.submit(points, options=FAST).id != first.id
    with pytest.raises(NotAllowedNow):
        client.submit(points + 1, options=FAST, idempotency_key=key)


def test_a_job_can_have_an_id_chosen_by_the_client(client: Client) -> None:
    points, mine = moving_points(), f"take-{secrets.token_hex(4)}"
    assert client.submit(points, options=FAST, job_id=mine).id == mine
    assert client.submit(points, options=FAST, job_id=mine).id == mine
    assert [job.id for job in client.list()].count(mine) == 1
    with pytest.raises(NotAllowedNow):
        client.submit(points + 1, options=FAST, job_id=mine)


def test_jobs_are_listed_newest_first_over_pages_and_by_status(client: Client) -> None:
    ids = [client.submit(moving_points(), options=FAST, name=str(i)).id for i in range(5)]
    assert [job.id for job in client.list(page_size=2)][:5] == ids[::-1]
    for page_size in (2, 50):
        assert [job.id for job in client.list(limit=3, page_size=page_size)] == ids[:1:-1]
    assert list(client.list(limit=0)) == []
    client.wait(ids[0], timeout=60)
    for id in ids[1:]:
        with suppress(NotAllowedNow):  # it may be done already
            client.cancel(id)
    assert ids[0] in [job.id for job in client.list(statuses=["succeeded"])]
    assert all(job.status is Status.SUCCEEDED for job in client.list(statuses=[Status.SUCCEEDED]))
    assert [job.id for job in client.list(statuses="succeeded")] == [
        job.id for job in client.list(statuses=["succeeded"])
    ]


def test_a_finished_job_can_be_deleted_but_not_cancelled(client: Client) -> None:
    job = client.submit(moving_points(), options=FAST)
    result = job.wait(timeout=60)
    assert job.status is Status.SUCCEEDED, "the record is that of the end, without another request"
    assert re.fullmatch(rf"<(Async)?Result of job {job.id}: 6 frames × 16 points, [\w, ]+>", repr(result))
    with pytest.raises(NotAllowedNow):
        job.cancel()
    assert job.refresh().status is Status.SUCCEEDED
    assert client.result(job.id).report["outcome"] in ("converged", "max_reweightings")
    job.delete()
    assert job.status is Status.SUCCEEDED, "its last state"
    with pytest.raises(NotFound):
        client.get(job.id)


def test_an_unknown_job_and_an_unknown_file_are_not_found(client: Client, tmp_path: Path) -> None:
    with pytest.raises(NotFound) as caught:
        client.get("no-such-job")
    assert caught.value.code == "unknown_job"
    result = client.submit(moving_points(), options=FAST).wait(timeout=60)
    with pytest.raises(NotFound, match=r"nonsense\.obj.*shapes\.npz"):
        result.download(tmp_path, names=["nonsense.obj"])
    assert result.download(tmp_path, names="report.json") == {"report.json": tmp_path / "report.json"}


def test_the_service_describes_its_options_and_limits(client: Client) -> None:
    assert client.options()["properties"]["loss"]["default"] == "l1"
    assert client.limits().max_frames > 100
    assert client.ready()["workers"] == "ok"


@pytest.mark.parametrize("door", [("async", "double"), ("async", "service")], indirect=True, ids="-".join)
def test_many_jobs_at_once(asked: dict[str, Any]) -> None:
    async def use() -> None:
        async with AsyncClient(**asked) as client:
            jobs = await asyncio.gather(
                *(client.submit(moving_points() + i, options=FAST, name=str(i)) for i in range(3))
            )
            results = await asyncio.gather(*(job.wait(timeout=60) for job in jobs))
            assert [result.job.name for result in results] == ["0", "1", "2"]
            assert [result.shapes.shape for result in results] == [(6, 16, 3)] * 3

    asyncio.run(use())


@EVERY_DOOR
def test_events_follow_a_job_from_the_queue_to_its_end(client: Client) -> None:
    job = client.submit(moving_points(), options=FAST)
    seen = list(job.events(timeout=60))
    assert [each.status for each in seen][-1] is Status.SUCCEEDED
    assert seen[-1].artifacts == client.get(job.id).record.artifacts
    order = list(Status)
    assert [order.index(each.status) for each in seen] == sorted(order.index(each.status) for each in seen)


def test_a_result_of_an_unfinished_job_is_an_error(client: Client) -> None:
    job = client.submit(**long_request())
    with pytest.raises(NotAllowedNow, match="no result yet"):
        client.result(job.id)
    job.cancel()


def test_cancelling_ends_the_wait_and_a_retry_is_a_new_job(kind: str, asked: dict[str, Any]) -> None:
    if "transport" in asked:
        asked["transport"] = InMemoryService(steps=math.inf)
    with opened(kind, asked) as client:
        job = client.submit(**long_request())
        seen = []
        for now in job.events(timeout=60):
            seen.append(now.status)
            if now.status is Status.RUNNING and seen.count(Status.RUNNING) == 1:
                client.cancel(job.id)
        with pytest.raises(JobCancelled) as caught:
            job.wait(timeout=60)
        assert seen[-1] is Status.CANCELLED
        assert caught.value.job.status is Status.CANCELLED
        again = job.retry()
        assert (again.record.retry_of, again.record.options) == (job.id, job.record.options)
        assert again.id != job.id
        with pytest.raises(NotAllowedNow):
            again.delete()
        again.cancel()


@EVERY_DOOR
def test_large_inputs_are_uploaded_first_with_the_same_result(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    points, key = moving_points(6, 4000), secrets.token_hex()
    carried = client.submit(points, options=FAST, idempotency_key=key)
    monkeypatch.setattr("pliant.client.multipart.RESUMABLE_BYTES", 100_000)
    monkeypatch.setattr("pliant.client.multipart.SMALL", 1000)
    updates: list[tuple[int, int]] = []
    ahead = client.submit(points, options=FAST, idempotency_key=key, on_upload=lambda *now: updates.append(now))
    assert ahead.id == carried.id, "the same content is the same request by either road"
    assert [done for done, _ in updates] == sorted(done for done, _ in updates)
    assert updates[-1][0] == updates[-1][1] > points.nbytes
    truth = np.zeros((6, 4000, 3)) + np.arange(4000)[:, None]
    job = client.submit(points, options=FAST, ground_truth=truth, mesh="none")
    assert job.record.interpretation.has_ground_truth
    for each in (job, carried):
        with suppress(NotAllowedNow):  # it may be done already
            each.cancel()
    with pytest.raises(InvalidRequest) as caught:
        client.submit(np.ones((2, 9000, 2)))
    assert caught.value.code == "too_few_frames"


def test_outputs_are_made_from_the_stored_result_without_solving(client: Client, tmp_path: Path) -> None:
    solved = client.submit(moving_points(), options={**FAST, "outputs": ("csv",)}, name="sheet")
    result = solved.wait(timeout=60)
    more = solved.make_outputs(["mdd", "glb"], fps=50)
    assert (more.record.outputs_of, more.record.name, more.record.options.fps) == (solved.id, "sheet", 50)
    done = more.wait(timeout=60)
    assert [each.name for each in done.job.artifacts] == ["shapes.glb", "shapes.mdd", "report.json"]
    assert (done.job.verdict, done.job.metrics) == (result.job.verdict, result.job.metrics)
    assert done.report["outputs_of"] == solved.id
    cache = done.download(tmp_path, names=["shapes.mdd"])["shapes.mdd"].read_bytes()
    assert np.frombuffer(cache, ">i4", 2).tolist() == [6, 16]
    np.testing.assert_allclose(np.frombuffer(cache, ">f4", 6, 8), np.arange(6) / 50, rtol=1e-6)
    upright = result.shapes * [1, -1, -1]
    np.testing.assert_allclose(np.frombuffer(cache, ">f4", offset=32).reshape(6, 16, 3), upright, rtol=1e-5, atol=1e-4)
    assert solved.make_outputs("glb,mdd", fps=50).id == more.id, "the same request returns the same job"
    assert solved.make_outputs(["mdd"]).id != more.id
    solved.delete()
    assert client.get(more.id).status is Status.SUCCEEDED, "it has copies of what it needs"
    with pytest.raises(NotFound):
        solved.make_outputs(["obj"])


def test_further_outputs_need_a_solved_job_and_valid_arguments(client: Client) -> None:
    job = client.submit(**long_request())
    with pytest.raises(NotAllowedNow, match="Wait until it has succeeded"):
        job.make_outputs(["obj"])
    job.cancel()
    with pytest.raises(BadArgument, match="outputs"):
        job.make_outputs(["fbx"])
    with pytest.raises(BadArgument, match="fps"):
        job.make_outputs(["glb"], fps=0)
    finished = client.submit(moving_points(), options=FAST)
    finished.wait(timeout=60)
    more = finished.make_outputs(["csv"])
    more.wait(timeout=60)
    with pytest.raises(NotAllowedNow, match=f"make them from that one|{finished.id}"):
        more.make_outputs(["obj"])


def test_stored_inputs_can_be_rerun_with_other_options(client: Client) -> None:
    first = client.submit(moving_points(), options={**FAST, "stride": 2}, name="walk")
    shapes = first.wait(timeout=60).shapes
    again = first.run_again({**FAST, "loss": "l2"})
    assert (again.record.name, again.record.options.stride, again.record.options.loss) == ("walk", 2, "l2")
    assert again.record.interpretation == first.record.interpretation
    assert again.wait(timeout=60).shapes.shape == shapes.shape
    with pytest.raises(InvalidRequest) as caught:
        first.run_again({**FAST, "stride": 3})
    assert (caught.value.code, caught.value.problem.field) == ("conflicting_parts", "options.stride")
    with pytest.raises(BadArgument, match="expected no other inputs, got tracks as well"):
        client.submit(moving_points(), inputs_of=first.id)
    with pytest.raises(NotFound) as unknown:
        client.submit(inputs_of="no-such-job")
    assert (unknown.value.code, unknown.value.problem.field) == ("unknown_job", "inputs_of")


def test_a_share_link_reads_one_result_until_it_is_revoked(
    client: Client, asked: dict[str, Any], tmp_path: Path
) -> None:
    job, other = (client.submit(moving_points(), options=FAST) for _ in range(2))
    job.wait(timeout=60)
    share = job.share(days=1)
    assert share.token is not None
    assert share.path == f"#share={share.token}"
    with opened("sync", {**asked, "token": share.token}) as guest:
        assert guest.get(job.id).status is Status.SUCCEEDED
        assert guest.result(job.id, folder=tmp_path).shapes.shape == (6, 16, 3)
        for forbidden in (lambda: guest.get(other.id), lambda: guest.log(job.id), lambda: guest.delete(job.id)):
            with pytest.raises(NotAuthorized) as caught:
                forbidden()
            assert caught.value.code == "beyond_share"
        assert [each.id for each in client.shares(job.id)] == [share.id]
        assert [each.token for each in client.shares(job.id)] == [None]
        client.revoke_share(job.id, share.id)
        with pytest.raises(NotAuthorized) as caught:
            guest.get(job.id)
        assert caught.value.code == "invalid_share"
    with pytest.raises(NotFound):
        client.revoke_share(job.id, share.id)
    with pytest.raises(BadArgument, match="a minute"):
        job.share(days=1000)


@pytest.mark.parametrize("door", DOORS[:2], indirect=True, ids="-".join)
def test_waiting_for_a_failed_job_raises_and_updates_its_status(kind: str) -> None:
    problem = Problem(title="Too short", status=422, code="too_few_frames", detail="Track more frames.")
    with opened(kind, {"url": "http://pliant.test", "transport": InMemoryService(problem=problem)}) as client:
        job = client.submit(moving_points(), options=FAST)
        with pytest.raises(JobFailed):
            job.wait(timeout=60)
        assert job.status is Status.FAILED
        assert repr(job) == f"<{'Async' if kind == 'async' else ''}RemoteJob {job.id} failed>"
