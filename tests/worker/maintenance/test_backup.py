"""Backups of a running installation, restored into an empty one; and what is refused."""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

import httpx
import pytest
from pliant.schemas.job import Artifact, Job, Problem, Status
from pliant.schemas.outputs import OutputRequest
from pliant.worker.errors import BadBackup, NewerData
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.further_outputs import make_outputs
from pliant.worker.jobs.service import Jobs
from pliant.worker.maintenance.backup import restore_backup, write_backup
from pliant.worker.maintenance.fsck import findings
from pliant.worker.maintenance.reconciler import Reconciler
from pliant.worker.records import Webhook
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.snapshot import Snapshot
from pliant.worker.tokens import Tokens

NOW = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)

Submit = Callable[..., Job]


@pytest.fixture(params=["redis"])
def jobs(settings: Settings) -> Jobs:
    return Jobs.open(settings)


@pytest.fixture
def empty(settings: Settings, tmp_path: Path) -> Settings:
    """Another machine, still empty."""
    return replace(settings, data=tmp_path / "elsewhere", queue=f"test-{secrets.token_hex(4)}")


def claim(jobs: Jobs, id: str) -> str:
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=NOW))
    return attempt_id


def succeed(jobs: Jobs, id: str, content: bytes, folder: Path) -> None:
    attempt_id = claim(jobs, id)
    file = folder / "result"
    file.write_bytes(content)
    prefix = f"jobs/{id}/{attempt_id}/artifacts/"
    jobs.blobs.put(f"{prefix}shapes.npz", file)
    file.unlink()
    digest = sha256(content).hexdigest()
    artifact = Artifact(name="shapes.npz", media_type="application/zip", bytes=len(content), sha256=digest)
    jobs.records.update(
        id,
        lambda held: lifecycle.succeed(
            held, Finished(metrics={"e": 0.5}, outcome="converged", sentence="Converged.", warnings=(), artifacts=(artifact,)),
            attempt_id=attempt_id, prefix=prefix, now=NOW, retention=0,
        ),
    )  # fmt: skip
    jobs.records.append_log(id, ["It went well."])


@pytest.fixture
def sent(jobs: Jobs, submit: Submit, tmp_path: Path) -> dict[str, str]:
    """One job in each state, and a token; returns the ids."""
    webhook = Webhook(url="https://example.org/hook", secret="whsec_c2VjcmV0")
    ids = {
        state: submit(name=state, webhook=webhook).id for state in ("done", "failed", "queued", "running", "cancelling")
    }
    succeed(jobs, ids["done"], secrets.token_bytes(100_000), tmp_path)
    for state in ("running", "cancelling"):
        jobs.queue.remove(claim(jobs, ids[state]))
    jobs.cancel(ids["cancelling"])
    jobs.queue.remove(jobs.records.get(ids["done"]).attempt_id)
    jobs.cancel(ids["failed"])
    Tokens.open(jobs.settings).create("somebody")
    return ids


def test_restore_recovers_the_installation(jobs: Jobs, sent: dict[str, str], empty: Settings, tmp_path: Path) -> None:
    made = write_backup(jobs.settings, tmp_path / "backup")
    assert (made.jobs, made.blobs, made.copied) == (5, 6, 6)
    assert restore_backup(empty, tmp_path / "backup").jobs == 5
    there = Jobs.open(empty)
    assert findings(there, pause=0) == []
    Reconciler(jobs=there).tick()
    assert findings(there, pause=0) == []
    assert there.get(sent["done"]) == jobs.get(sent["done"])
    assert there.log(sent["done"]) == jobs.log(sent["done"]) == "It went well.\n"
    _, blob = there.artifact(sent["done"], "shapes.npz")
    assert b"".join(blob.read()) == b"".join(jobs.artifact(sent["done"], "shapes.npz")[1].read())
    states = {name: there.get(id).status for name, id in sent.items()}
    assert states == {
        "done": Status.SUCCEEDED, "failed": Status.CANCELLED, "queued": Status.QUEUED, "running": Status.QUEUED,
        "cancelling": Status.CANCELLED,
    }  # fmt: skip
    assert len(there.queue.waiting()) == 2
    assert Tokens.open(empty).all() == Tokens.open(jobs.settings).all()
    assert there.records.tallies()["ended:succeeded"] == 1


def test_restore_observes_the_limit_of_running_jobs(
    jobs: Jobs, submit: Submit, empty: Settings, tmp_path: Path
) -> None:
    for _ in range(3):
        submit()
    write_backup(jobs.settings, tmp_path / "backup")
    restore_backup(empty, tmp_path / "backup")
    there = Jobs.open(
        replace(empty, max_running=1)
    )  # the limit is the service's, and may not be set where `pliant restore` runs
    Reconciler(jobs=there).tick()
    assert (len(there.queue.waiting()), len(there.queue.held())) == (1, 2)


def test_a_further_outputs_job_keeps_its_source_result_in_a_backup(
    jobs: Jobs, submit: Submit, empty: Settings, tmp_path: Path
) -> None:
    solved = submit(name="done").id
    succeed(jobs, solved, b"the shapes", tmp_path)
    jobs.queue.remove(jobs.records.get(solved).attempt_id)
    more, _ = make_outputs(jobs, solved, OutputRequest(outputs=("obj",)))
    assert write_backup(jobs.settings, tmp_path / "backup").blobs == 4
    restore_backup(empty, tmp_path / "backup")
    there = Jobs.open(empty)
    assert findings(there, pause=0) == []
    key = there.stored(more.id).result
    assert key is not None
    assert b"".join(there.blobs.get(key).read()) == b"the shapes"


def test_pending_webhooks_are_restored(jobs: Jobs, sent: dict[str, str], empty: Settings, tmp_path: Path) -> None:
    from pliant.worker.store.connection import connect

    write_backup(jobs.settings, tmp_path / "backup")
    restore_backup(empty, tmp_path / "backup")
    client = connect(empty.redis, decode=True)
    assert sent["done"] in client.zrange(f"{empty.queue}:outbox", 0, -1)
    client.close()


def test_a_second_backup_copies_new_files_and_drops_deleted_ones(
    jobs: Jobs, sent: dict[str, str], submit: Submit, tmp_path: Path
) -> None:
    backup = tmp_path / "backup"
    write_backup(jobs.settings, backup)
    new = submit(name="new").id
    jobs.delete(sent["done"])
    again = write_backup(jobs.settings, backup)
    assert (again.jobs, again.copied) == (5, 1)
    held = {path.relative_to(backup / "blobs").parts[1] for path in (backup / "blobs").rglob("*") if path.is_file()}
    assert held == {new, *(id for name, id in sent.items() if name != "done")}
    assert len(list(backup.glob("jobs-*"))) == len(list(backup.glob("rest-*"))) == 1


def test_files_reach_the_disk_before_those_of_the_earlier_backup_are_removed(
    jobs: Jobs, sent: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backup, seen = tmp_path / "backup", []
    write_backup(jobs.settings, backup)
    earlier = json.loads((backup / "manifest.json").read_text())
    jobs.delete(sent["done"])

    def look() -> None:
        names = {path.name for path in backup.iterdir()}
        assert set(earlier["files"]) < names
        assert all((backup / "blobs" / key).is_file() for key in earlier["blobs"])
        seen.append((json.loads((backup / "manifest.json").read_text()) == earlier, "manifest.json.new" in names))

    monkeypatch.setattr("pliant.worker.maintenance.backup.os.sync", look)
    write_backup(jobs.settings, backup)
    assert seen == [(True, True), (False, False)]


def test_a_job_deleted_during_the_backup_is_omitted(
    jobs: Jobs, sent: dict[str, str], empty: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Blobs.get

    def gone(blobs: Blobs, key: str) -> object:
        if sent["failed"] in key:
            jobs.delete(sent["failed"])
        return plain(blobs, key)

    monkeypatch.setattr(Blobs, "get", gone)
    assert write_backup(jobs.settings, tmp_path / "backup").jobs == 4
    monkeypatch.undo()
    restore_backup(empty, tmp_path / "backup")
    assert findings(Jobs.open(empty), pause=0) == []


def test_a_backup_without_the_services_blob_store_is_refused_and_keeps_the_earlier_one(
    jobs: Jobs, sent: dict[str, str], empty: Settings, tmp_path: Path
) -> None:
    write_backup(jobs.settings, tmp_path / "backup")
    other = replace(jobs.settings, blob_url=(tmp_path / "other").as_uri())
    with pytest.raises(BadBackup, match=r"has lost its file jobs/.* Check that PLIANT_BLOB_URL is that of the service"):
        write_backup(other, tmp_path / "backup")
    assert restore_backup(empty, tmp_path / "backup").jobs == len(sent)


def test_a_result_that_was_cut_off_is_not_backed_up(jobs: Jobs, sent: dict[str, str], tmp_path: Path) -> None:
    done = jobs.records.get(sent["done"])
    key = f"{done.prefix}{done.job.artifacts[0].name}"
    jobs.blobs.delete(key)
    jobs.blobs.write(key, b"cut off")
    with pytest.raises(BadBackup, match=f"Job {sent['done']} has lost its file {key}: it is not complete"):
        write_backup(jobs.settings, tmp_path / "backup")
    jobs.delete(sent["done"])
    assert write_backup(jobs.settings, tmp_path / "backup").jobs == len(sent) - 1


@pytest.fixture
def backup(jobs: Jobs, sent: dict[str, str], tmp_path: Path) -> Path:
    write_backup(jobs.settings, tmp_path / "backup")
    copy = tmp_path / "copy"  # blobs of the backup are linked from the store
    shutil.copytree(tmp_path / "backup", copy)
    return copy


def test_invalid_backups_and_targets_are_refused(jobs: Jobs, backup: Path, empty: Settings, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("Dear")
    for place in (tmp_path / "other", tmp_path / "other" / "letter.txt"):
        with pytest.raises(BadBackup, match="is not a backup"):
            write_backup(jobs.settings, place)
    with pytest.raises(BadBackup, match=r"manifest\.json cannot be read"):
        restore_backup(empty, tmp_path / "other")
    with pytest.raises(BadBackup, match="already has jobs or tokens"):
        restore_backup(jobs.settings, backup)


def test_a_job_that_changes_during_a_backup_appears_once(jobs: Jobs, sent: dict[str, str]) -> None:
    """Files are copied between two records, which takes minutes."""
    listed = Snapshot(jobs.settings).jobs()
    first = next(listed)["record"]["job"]["id"]
    assert first == sent["queued"]
    jobs.cancel(first)  # its status now comes after the present one
    lost = Problem.of("worker_lost", 500, detail="The worker is gone.")
    jobs.records.update(
        sent["running"],
        lambda held: lifecycle.requeue(
            held, attempt_id=held.attempt_id, fresh="0" * 20, problem=lost, now=NOW, max_attempts=None, retention=0
        ),
    )  # its status comes before the present one
    assert sorted([first, *(each["record"]["job"]["id"] for each in listed)]) == sorted(sent.values())


def test_an_interrupted_first_backup_is_continued(
    jobs: Jobs, sent: dict[str, str], empty: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "backup"
    with monkeypatch.context() as broken:
        broken.setattr(Snapshot, "rest", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_backup(jobs.settings, target)
    assert not (target / "manifest.json").exists()
    assert list(target.glob("jobs-*"))
    summary = write_backup(jobs.settings, target)
    assert (summary.jobs, summary.copied) == (len(sent), 0)
    assert len(list(target.glob("jobs-*"))) == 1, "the remains are gone"
    assert restore_backup(empty, target).jobs == len(sent)


@pytest.mark.parametrize(
    "what", ["jobs-*", "blobs/**/inputs.npz", "blobs/**/shapes.npz", "flipped", "format", "schema", "record"]
)
def test_a_damaged_backup_is_refused_before_anything_is_written(backup: Path, empty: Settings, what: str) -> None:
    error: type[Exception] = BadBackup
    manifest = json.loads((backup / "manifest.json").read_text())
    if what == "flipped":  # the same size, another content
        file = next(backup.glob("blobs/**/shapes.npz"))
        content = bytearray(file.read_bytes())
        content[500] ^= 1
        file.write_bytes(content)
    elif what == "format":
        (backup / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    elif what == "schema":
        error = NewerData
        (backup / "manifest.json").write_text(json.dumps({**manifest, "schema": 99}))
    elif what == "record":  # of a newer process that ran beside the one that made the backup
        error = NewerData
        file = next(backup.glob("jobs-*"))
        *others, last = map(json.loads, file.read_text().splitlines())
        last["record"]["schema"] = 99
        file.write_text("".join(json.dumps(line) + "\n" for line in [*others, last]))
        manifest["files"][file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
        (backup / "manifest.json").write_text(json.dumps(manifest))
    else:
        file = next(backup.glob(what))
        file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(error):
        restore_backup(empty, backup)
    there = Jobs.open(empty)
    assert (there.count(list(Status)), there.blobs.list()) == (0, [])


@pytest.mark.s3
def test_files_restored_to_s3_have_their_media_type(
    jobs: Jobs, submit: Submit, empty: Settings, s3_url: str, tmp_path: Path
) -> None:
    id = submit(name="done").id
    succeed(jobs, id, b"result", tmp_path)
    write_backup(jobs.settings, tmp_path / "backup")
    there = replace(empty, blob_url=f"{s3_url}-{secrets.token_hex(3)}")
    restore_backup(there, tmp_path / "backup")
    _, blob = Jobs.open(there).artifact(id, "shapes.npz")
    link = blob.link(seconds=60)
    assert link is not None
    answer = httpx.get(link)
    assert (answer.content, answer.headers["content-type"]) == (b"result", "application/zip")
