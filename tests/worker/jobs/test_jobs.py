"""The operations on jobs: one suite, on Redis with a directory of blobs and on in-memory stores."""

from __future__ import annotations

import dataclasses
import threading
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest
from pliant.schemas.job import Artifact, Job, Problem, Progress, Status
from pliant.worker.errors import (
    Conflict,
    InvalidRequest,
    NotAllowedNow,
    QuotaExceeded,
    StaleAttempt,
    UnknownArtifact,
    UnknownJob,
)
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.retry import retry
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.records import Stored, utc_now
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.redis import RedisRecords
from pliant.worker.uploads.service import Capacity, Uploads

NOW = datetime(2030, 1, 2, tzinfo=UTC)
PROBLEM = Problem(
    title="Lost", status=503, detail="The worker was lost. Try again.", code="worker_lost", retryable=True
)


def claim(jobs: Jobs, id: str) -> Stored:
    attempt_id = jobs.records.get(id).attempt_id
    return jobs.records.update(id, lambda stored: lifecycle.claim(stored, attempt_id=attempt_id, worker="w", now=NOW))


def finish(jobs: Jobs, id: str, file: Path) -> Stored:
    attempt_id = claim(jobs, id).attempt_id
    prefix = f"jobs/{id}/{attempt_id}/"
    jobs.blobs.put(f"{prefix}report.json", file)
    artifact = Artifact(name="report.json", media_type="application/json", bytes=file.stat().st_size, sha256="0" * 64)
    return jobs.records.update(
        id,
        lambda stored: lifecycle.succeed(
            stored,
            Finished(
                metrics={"reprojection_median": 0.5}, outcome="converged", sentence="Converged.", warnings=(), artifacts=(artifact,),
                verdict="with_care", verdict_reasons=("It turns by only 9°.",), trust_sentence="Expected error about 4 %.",
            ),
            attempt_id=attempt_id, prefix=prefix, now=NOW, retention=60,
        ),
    )  # fmt: skip


def blob_names(jobs: Jobs) -> list[str]:
    return [key for key, _ in jobs.blobs.list("jobs/")]


def test_a_submitted_job_has_a_record_a_blob_and_a_queue_position(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    first, second = submit(name="first"), submit(name="second")
    assert (first.status, first.place_in_queue, second.place_in_queue) == (Status.QUEUED, 0, 1)
    assert jobs.get(second.id) == second
    stored = jobs.records.get(first.id)
    assert b"".join(jobs.blobs.get(stored.inputs).read()) == inputs_file.read_bytes()
    assert jobs.queue.waiting() == [stored.attempt_id, jobs.records.get(second.id).attempt_id]
    assert jobs.records.used() == 2 * inputs_file.stat().st_size


def test_an_unknown_job_is_an_error(jobs: Jobs) -> None:
    for id in ("nobody", "../etc/passwd", "x" * 500):
        with pytest.raises(UnknownJob, match="List your jobs"):
            jobs.get(id)


def test_pages_hold_every_job_once_newest_first(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ids = [submit(id=f"job-{number}").id for number in range(5)]
    claim(jobs, "job-3")
    seen, cursor = [], None
    for _ in range(3):
        page = jobs.page(limit=2, cursor=cursor)
        seen += [job.id for job in page.jobs]
        cursor = page.next
    assert cursor is None
    order = sorted(ids, key=lambda id: jobs.records.get(id).sort_key, reverse=True)
    assert seen == order
    running = jobs.page(statuses=[Status.RUNNING])
    assert [job.id for job in running.jobs] == ["job-3"]
    places = {job.id: job.place_in_queue for job in jobs.page().jobs}
    assert places == {"job-0": 0, "job-1": 1, "job-2": 2, "job-3": 3, "job-4": 4} | {"job-3": None}
    assert jobs.count([Status.QUEUED, Status.RUNNING]) == 5


@pytest.mark.parametrize(
    ("arguments", "code"),
    [({"cursor": "nonsense"}, "invalid_cursor"), ({"limit": 0}, "invalid_limit"), ({"limit": 201}, "invalid_limit")],
)
def test_invalid_cursors_and_limits_are_rejected(jobs: Jobs, arguments: dict[str, object], code: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        jobs.page(**arguments)  # type: ignore[arg-type]
    assert caught.value.code == code


def test_owners_see_only_their_own_jobs(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ann, bob = jobs.of("ann"), jobs.of("bob")
    hers, his = submit(ann), submit(bob)
    assert ann.get(hers.id).id == hers.id
    for call in (bob.get, bob.cancel, partial(retry, bob), bob.delete, bob.log, bob.events):
        with pytest.raises(UnknownJob):
            call(hers.id)
    with pytest.raises(UnknownJob):
        bob.artifact(hers.id, "report.json")
    assert [job.id for job in bob.page().jobs] == [his.id]
    assert {job.id for job in jobs.page().jobs} == {hers.id, his.id}
    assert (ann.count([Status.QUEUED]), jobs.count([Status.QUEUED])) == (1, 2)


def test_a_repeated_request_returns_the_first_job(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    first = submit(idempotency_key="k", fingerprint="f")
    assert submit(idempotency_key="k", fingerprint="f").id == first.id
    with pytest.raises(Conflict, match="Use a new key") as caught:
        submit(idempotency_key="k", fingerprint="other")
    assert (caught.value.code, caught.value.id) == ("idempotency_conflict", first.id)
    assert submit(jobs.of("ann"), idempotency_key="k", fingerprint="f").id != first.id, "keys are the owner's own"
    assert len(jobs.queue.waiting()) == 2
    assert len(blob_names(jobs)) == 2


@pytest.mark.parametrize("jobs", ["redis"], indirect=True)
@pytest.mark.parametrize("during", ["find", "create"])
def test_a_request_whose_first_job_is_deleted_meanwhile_creates_a_new_job(
    jobs: Jobs, submit, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:  # type: ignore[no-untyped-def]
    first = submit(idempotency_key="k", fingerprint="f")
    read, deleted = RedisRecords.get, []

    def delete_before(records: RedisRecords, id: str) -> Stored:
        if not deleted:
            deleted.append(id)
            records.delete(read(records, id), at=utc_now())
        return read(records, id)

    monkeypatch.setattr(RedisRecords, "get", delete_before)
    if during == "create":  # the first job is stored between the two
        monkeypatch.setattr(RedisRecords, "find", lambda records, key: None)
    again = submit(idempotency_key="k", fingerprint="f")
    assert deleted == [first.id]
    assert again.id != first.id
    assert jobs.get(again.id).status is Status.QUEUED


def test_a_chosen_id_can_be_used_only_once(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    assert submit(id="mine", fingerprint="f").id == "mine"
    assert submit(id="mine", fingerprint="f").id == "mine"
    for more in ({"fingerprint": "other"}, {}):
        with pytest.raises(Conflict, match="Choose another id") as caught:
            submit(id="mine", **more)
        assert caught.value.code == "id_taken"
    with pytest.raises(Conflict):
        submit(jobs.of("ann"), id="mine", fingerprint="f")
    with pytest.raises(InvalidRequest, match="3–64"):
        submit(id="no/slashes")
    with pytest.raises(InvalidRequest, match="random UUID"):
        submit(idempotency_key="")
    assert len(blob_names(jobs)) == 1


def test_simultaneous_requests_with_one_key_make_one_job(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    made: list[str] = []
    gate = threading.Barrier(6)

    def call() -> None:
        gate.wait()
        made.append(submit(idempotency_key="k", fingerprint="f").id)

    threads = [threading.Thread(target=call) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 6
    assert len(set(made)) == 1
    assert len(blob_names(jobs)) == 1
    assert jobs.records.used() == 3_000_000
    assert len(jobs.queue.waiting()) == 1


def test_only_the_current_attempt_can_change_a_job(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    old = claim(jobs, id).attempt_id
    with pytest.raises(StaleAttempt):
        jobs.records.update(id, lambda stored: lifecycle.claim(stored, attempt_id=old, worker="twin", now=NOW))
    jobs.records.update(
        id,
        lambda stored: lifecycle.requeue(
            stored, attempt_id=old, fresh="new-attempt_id", problem=PROBLEM, now=NOW, max_attempts=2, retention=0
        ),
    )
    assert jobs.get(id).status is Status.QUEUED
    assert jobs.records.beat(id, old) is None
    assert jobs.records.look(id, old) is None
    progress = Progress(stage="reweight", fraction=0.5, updated_at=NOW)
    before = jobs.records.get(id)
    for change in (
        lambda stored: lifecycle.report(stored, attempt_id=old, progress=progress),
        lambda stored: lifecycle.fail(stored, attempt_id=old, problem=PROBLEM, now=NOW, retention=0),
        lambda stored: lifecycle.stop(stored, attempt_id=old, now=NOW, retention=0),
        lambda stored: lifecycle.redeliver(stored, attempt_id=old, fresh="newer"),
    ):
        with pytest.raises(StaleAttempt):
            jobs.records.update(id, change)
    assert jobs.records.get(id) == before


def test_a_claim_can_be_repeated_if_its_reply_was_lost(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    first = claim(jobs, id)
    assert claim(jobs, id) == first == jobs.records.get(id)
    assert first.job.attempt == 1
    for worker, now in (("w", NOW + timedelta(microseconds=1)), ("other", NOW)):
        with pytest.raises(StaleAttempt):
            jobs.records.update(
                id, partial(lifecycle.claim, attempt_id=first.attempt_id, worker=worker, now=now)
            )  # a second delivery
    jobs.cancel(id)
    assert claim(jobs, id).job.status is Status.CANCELLING
    jobs.records.update(id, partial(lifecycle.stop, attempt_id=first.attempt_id, now=NOW, retention=0))
    with pytest.raises(StaleAttempt):
        claim(jobs, id)


def test_an_attempt_stops_only_for_a_cancellation(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    own = claim(jobs, submit().id)
    with pytest.raises(StaleAttempt):
        jobs.records.update(own.job.id, partial(lifecycle.stop, attempt_id=own.attempt_id, now=NOW, retention=0))
    assert jobs.get(own.job.id).status is Status.RUNNING


def test_a_job_fails_after_losing_too_many_workers(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    for attempt in (1, 2):
        attempt_id = claim(jobs, id).attempt_id
        after = jobs.records.update(
            id,
            lambda stored, attempt_id=attempt_id, attempt=attempt: lifecycle.requeue(  # type: ignore[misc]
                stored,
                attempt_id=attempt_id,
                fresh=f"t{attempt}",
                problem=PROBLEM,
                now=NOW,
                max_attempts=2,
                retention=60,
            ),
        )
    assert (after.job.status, after.job.error, after.job.attempt) == (Status.FAILED, PROBLEM, 2)
    assert after.job.expires_at == NOW + timedelta(seconds=60)


def test_stops_of_the_installation_do_not_count_as_lost_workers(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    for attempt, most in enumerate((None, None, None, 2, 2)):
        held = claim(jobs, id)
        assert held.job.attempt == attempt + 1
        again = partial(lifecycle.requeue, fresh=f"t{attempt}", problem=PROBLEM, now=NOW, retention=0)
        after = jobs.records.update(id, partial(again, attempt_id=held.attempt_id, max_attempts=most))
        assert after.job.status is (Status.QUEUED if attempt < 4 else Status.FAILED)


def test_unfinished_jobs_can_be_cancelled_and_finished_ones_cannot(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    queued, running, done = submit(), submit(), submit()
    assert jobs.cancel(queued.id).status is Status.CANCELLED
    attempt_id = claim(jobs, running.id).attempt_id
    assert jobs.cancel(running.id).status is Status.CANCELLING
    assert jobs.cancel(running.id).status is Status.CANCELLING, "asking twice is no error"
    assert jobs.records.beat(running.id, attempt_id) is Status.CANCELLING
    late = jobs.records.update(
        running.id, lambda stored: lifecycle.fail(stored, attempt_id=attempt_id, problem=PROBLEM, now=NOW, retention=0)
    )
    assert (late.job.status, late.job.error, late.job.expires_at) == (Status.CANCELLED, None, None)
    finish(jobs, done.id, inputs_file)
    with pytest.raises(NotAllowedNow, match="delete it"):
        jobs.cancel(done.id)
    assert [attempt_id.rsplit("-", 1)[0] for attempt_id in jobs.queue.waiting()] == [running.id, done.id], (
        "tokens not yet taken"
    )


def test_the_progress_of_a_succeeded_job_is_complete(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    stored = claim(jobs, submit().id)
    late = Progress(stage="exporting", fraction=0.993, seconds_left=0.1, updated_at=NOW)
    reported = lifecycle.report(stored, attempt_id=stored.attempt_id, progress=late)
    done = Finished(metrics={}, outcome="converged", sentence="Converged.", warnings=(), artifacts=())
    ended = lifecycle.succeed(reported, done, attempt_id=stored.attempt_id, prefix="p/", now=NOW, retention=0)
    assert ended.job.progress == late.model_copy(update={"fraction": 1.0, "seconds_left": 0.0})


def test_a_result_is_published_and_read_in_ranges(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    with pytest.raises(UnknownArtifact, match="only a succeeded job"):
        jobs.artifact(id, "report.json")
    stored = finish(jobs, id, inputs_file)
    assert stored.bytes == jobs.records.used() == 6_000_000
    job = jobs.get(id)
    assert (job.status, job.outcome, job.metrics) == (Status.SUCCEEDED, "converged", {"reprojection_median": 0.5})
    assert (job.verdict, job.trust_sentence) == ("with_care", "Expected error about 4 %.")
    assert job.verdict_reasons == ["It turns by only 9°."]
    artifact, blob = jobs.artifact(id, "report.json")
    assert artifact.bytes == blob.size == 3_000_000
    assert sum(len(chunk) for chunk in blob.read(10, 2_500_000)) == 2_499_990
    assert list(blob.read(5, 5)) == []
    with pytest.raises(ValueError, match="of a file of 3000000 bytes"):
        next(blob.read(0, 3_000_001))
    with pytest.raises(UnknownArtifact, match=r"It has: report\.json"):
        jobs.artifact(id, "shapes.npz")


def test_deleting_a_job_removes_its_record_files_and_log(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    id = submit(idempotency_key="k", fingerprint="f").id
    with pytest.raises(NotAllowedNow, match="Cancel it first"):
        jobs.delete(id)
    finish(jobs, id, inputs_file)
    jobs.records.append_log(id, ["one", "two"])
    assert jobs.log(id) == "one\ntwo\n"
    jobs.delete(id)
    assert blob_names(jobs) == []
    assert jobs.records.used() == 0
    assert jobs.page().jobs == []
    assert jobs.records.log(id) == []
    jobs.records.append_log(id, ["too late"])
    assert jobs.records.log(id) == []
    with pytest.raises(UnknownJob):
        jobs.delete(id)
    assert submit(idempotency_key="k", fingerprint="g").id != id, "the key is free again"


def test_a_job_that_is_being_cancelled_is_not_to_be_cancelled_first(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="me", now=jobs.clock()))
    jobs.cancel(id)
    with pytest.raises(NotAllowedNow, match=r"cannot be deleted now\. Delete it when it is cancelled\."):
        jobs.delete(id)


def test_a_new_job_with_the_id_of_one_being_deleted_keeps_its_files(
    jobs: Jobs,
    submit,  # type: ignore[no-untyped-def]
    inputs_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    finish(jobs, submit(id="nightly").id, inputs_file)
    plain, new = Blobs.delete, []

    def after_another(blobs: Blobs, prefix: str) -> None:
        if not new:
            new.append(submit(id="nightly", name="the next night"))
        plain(blobs, prefix)

    with monkeypatch.context() as slow:
        slow.setattr(Blobs, "delete", after_another)
        jobs.delete("nightly")
    assert jobs.get("nightly") == new[0]
    assert blob_names(jobs) == [jobs.records.get("nightly").inputs]


def test_a_late_deletion_keeps_a_new_job_with_the_same_id(
    jobs: Jobs,
    submit,  # type: ignore[no-untyped-def]
    inputs_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    old = finish(jobs, submit(id="nightly").id, inputs_file)
    jobs.delete("nightly")
    new = submit(id="nightly", name="the next night")
    with monkeypatch.context() as late:
        late.setattr(Jobs, "stored", lambda *_: old)  # this deletion has read the record before all that
        jobs.delete("nightly")
    assert jobs.get("nightly") == new
    assert blob_names(jobs) == [jobs.records.get("nightly").inputs]


def test_leftovers_of_a_lost_attempt_are_noted_for_the_reconciler(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    finish(jobs, id, inputs_file)
    left = f"jobs/{id}/{id}-lost/artifacts/shapes.npz"
    jobs.blobs.put(left, inputs_file)
    jobs.delete(id)
    assert blob_names(jobs) == [left]
    assert list(jobs.records.deleted()) == [id]


def test_a_retry_is_a_new_job_with_the_same_inputs(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    old = submit(jobs.of("ann"), name="n")
    with pytest.raises(NotAllowedNow, match="cancel it first"):
        retry(jobs, old.id)
    jobs.cancel(old.id)
    again = retry(jobs, old.id)
    assert (again.retry_of, again.name, again.options, again.status) == (old.id, "n", old.options, Status.QUEUED)
    assert jobs.get(old.id).status is Status.CANCELLED, "final statuses never change"
    jobs.delete(old.id)
    assert b"".join(jobs.blobs.get(jobs.records.get(again.id).inputs).read()) == inputs_file.read_bytes()
    assert jobs.of("ann").get(again.id).id == again.id
    finish(jobs, again.id, inputs_file)
    with pytest.raises(NotAllowedNow, match="already has a result"):
        retry(jobs, again.id)


def test_events_report_every_change_once(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    first = jobs.events(id)
    assert [event.name for event in first] == ["job"]
    assert Job.model_validate_json(first[0].data).status is Status.QUEUED
    assert jobs.events(id, after=first[-1].id) == []
    attempt_id = claim(jobs, id).attempt_id
    progress = Progress(stage="reweight", fraction=0.5, updated_at=NOW)
    changes = jobs.records.changes()
    while changes.next(0.05):
        pass
    seen = jobs.events(id)[-1].id
    jobs.records.update(id, lambda stored: lifecycle.report(stored, attempt_id=attempt_id, progress=progress))
    assert changes.next(5) == {id}
    assert [event.name for event in jobs.events(id, after=seen)] == ["progress"]
    assert changes.next(0.05) == set()
    jobs.cancel(id)
    jobs.records.update(id, lambda stored: lifecycle.stop(stored, attempt_id=attempt_id, now=NOW, retention=0))
    assert changes.next(5) == {id}
    last = jobs.events(id)[-1]
    assert Job.model_validate_json(last.data).status is Status.CANCELLED
    for wrong in ("yesterday", f"{2**64}-0", "99999999999999999999-0"):
        with pytest.raises(InvalidRequest, match="Last-Event-ID"):
            jobs.events(id, after=wrong)
    jobs.delete(id)
    assert changes.next(5) == {id}
    changes.close()


def test_events_are_capped(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    attempt_id = claim(jobs, id).attempt_id
    for number in range(300):
        progress = Progress(stage="reweight", fraction=number / 300, updated_at=NOW)
        jobs.records.update(id, lambda stored, p=progress: lifecycle.report(stored, attempt_id=attempt_id, progress=p))  # type: ignore[misc]
    assert len(jobs.events(id)) == 256
    jobs.cancel(id)
    jobs.records.update(id, lambda stored: lifecycle.stop(stored, attempt_id=attempt_id, now=NOW, retention=0))
    kept = jobs.events(id)
    assert len(kept) == 16
    assert Job.model_validate_json(kept[-1].data).status is Status.CANCELLED


def test_the_quota_rejects_jobs_that_do_not_fit(jobs: Jobs, submit, inputs_file: Path) -> None:  # type: ignore[no-untyped-def]

    tight = dataclasses.replace(jobs, settings=dataclasses.replace(jobs.settings, disk_quota=4_000_000))
    submit(tight)
    with pytest.raises(QuotaExceeded, match=r"3,002,460 of 4,000,000 bytes.*PLIANT_DISK_QUOTA"):
        submit(tight)
    assert len(blob_names(jobs)) == 1


def test_readiness_names_each_part(jobs: Jobs) -> None:
    found = jobs.ready()
    assert (found["redis"], found["blobs"]) == ("ok", "ok")
    assert found["workers"] == "ok" or "pliant work" in found["workers"]


def test_a_retry_during_a_deletion_reports_an_unknown_job(jobs: Jobs, submit, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    id = submit().id
    jobs.cancel(id)
    known = Jobs.known

    def deleted_meanwhile(door: Jobs, submission: Submission) -> Job | None:
        jobs.delete(id)
        return known(door, submission)

    monkeypatch.setattr(Jobs, "known", deleted_meanwhile)
    with pytest.raises(UnknownJob):
        retry(jobs, id)
    assert jobs.records.ids(Status.QUEUED) == []
    assert jobs.records.deleted() == {}


def test_uploads_count_against_the_quota_which_is_checked_on_writing(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    tight = dataclasses.replace(jobs, settings=dataclasses.replace(jobs.settings, disk_quota=4_000_000))
    uploads = Uploads.open(tight.settings)
    with uploads.write("big-one", offset=0, length=None, capacity=Capacity(max_bytes=10**7)) as writer:
        writer.write(bytes(1_500_000))
    with pytest.raises(QuotaExceeded, match="1,500,000 of 4,000,000 bytes"):
        submit(tight)
    uploads.delete("big-one")
    stored = jobs.records.get(submit(tight).id)
    job = stored.job.model_copy(update={"id": "another"})
    with pytest.raises(QuotaExceeded, match="3,002,460 of 4,000,000 bytes"):
        jobs.records.create(stored.model_copy(update={"job": job}), max_bytes=4_000_000)
    assert jobs.records.used() == 3_002_460
