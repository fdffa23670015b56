"""The log: one line per request, the reason of every error, the request's id, and no secrets."""

from __future__ import annotations

import io
import json
import logging

import httpx
import pytest
from pliant.worker.errors import WorkerError
from pliant.worker.logs import REQUEST_ID, AddRequestId, configure_logging, formatter
from serving import Running, Serve, submit, until


def lines(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [record for record in caplog.records if record.name == "pliant.access"]


@pytest.fixture(autouse=True)
def at_info(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)


def test_request_ids_are_kept_and_access_log_lines_name_the_job(
    http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    answer = http.get("/v1/options", headers={"X-Request-ID": "from-proxy:7"})
    assert answer.headers["x-request-id"] == "from-proxy:7"
    job = submit(http, name="logged")
    found = http.get(f"/v1/jobs/{job.id}")
    own = found.headers["x-request-id"]
    assert len(own) == 16
    until(lambda: len([record for record in lines(caplog) if vars(record).get("job") == job.id]) == 2)
    posted, read = (record for record in lines(caplog) if vars(record).get("job") == job.id)
    assert (vars(posted)["method"], vars(posted)["status"], posted.levelname) == ("POST", 202, "INFO")
    assert read.getMessage().startswith(f"GET /v1/jobs/{job.id} 200 ")


@pytest.mark.parametrize("id", ["a b", "x" * 129, "a\tb", "naïve"])
def test_an_invalid_request_id_is_replaced(http: httpx.Client, id: str) -> None:
    answer = http.get("/healthz", headers={"X-Request-ID": id.encode()})
    assert answer.headers["x-request-id"] != id
    assert len(answer.headers["x-request-id"]) == 16


def test_rejections_are_logged_with_their_code_and_without_secrets(
    http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    http.get("/v1/jobs/nobody-here?token=SECRET", headers={"Authorization": "Bearer SECRET"})
    until(lambda: any(vars(record).get("job") == "nobody-here" for record in lines(caplog)))
    (record,) = [record for record in lines(caplog) if vars(record).get("job") == "nobody-here"]
    assert (record.levelname, vars(record)["code"]) == ("WARNING", "unknown_parameter")
    ours = [record for record in caplog.records if record.name.startswith("pliant")]
    assert all("SECRET" not in str(vars(record)) for record in ours)
    http.get("/v1/jobs/a%0Ab%1B")
    until(lambda: any("%0Ab" in record.getMessage() for record in lines(caplog)))
    assert all("\n" not in record.getMessage() and "\x1b" not in record.getMessage() for record in lines(caplog))


def test_mapped_and_unexpected_errors_of_the_service_are_logged(
    serve: Serve, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    running: Running = serve()

    def fail(error: Exception) -> None:
        def raised(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr("pliant.worker.jobs.service.Jobs.page", raised)

    with httpx.Client(base_url=running.url, timeout=20) as http:
        fail(WorkerError("The machinery broke."))
        mapped = http.get("/v1/jobs", headers={"X-Request-ID": "mapped-1"})
        assert (mapped.status_code, mapped.json()["code"]) == (500, "worker_error")
        fail(KeyError("a defect"))
        defect = http.get("/v1/jobs", headers={"X-Request-ID": "defect-1"})
        assert (defect.status_code, defect.json()["code"]) == (500, "internal_error")
        assert defect.headers["x-request-id"] == "defect-1"
    until(lambda: len([record for record in lines(caplog) if vars(record)["status"] == 500]) == 2)
    assert {record.levelname for record in lines(caplog)} == {"ERROR"}
    assert "WorkerError: The machinery broke." in caplog.text
    assert "raise error" in caplog.text, "with the traceback"


@pytest.mark.parametrize(("more", "level"), [({}, "WARNING"), ({"redis": "ok", "blobs": "ok"}, "INFO")])
def test_a_start_without_workers_is_no_warning(
    serve: Serve, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, more: dict[str, str], level: str
) -> None:
    """`pliant up` asks until all parts answer, and shows warnings. The access log never warns of this expected answer."""
    running = serve(auth="required")
    parts = {"redis": "The store is away.", "blobs": "ok", "workers": "No worker is running.", **more}
    monkeypatch.setattr("pliant.worker.jobs.service.Jobs.ready", lambda _: parts)
    assert httpx.get(f"{running.url}/readyz").status_code == 503
    until(lambda: len(lines(caplog)) == 1)
    assert (lines(caplog)[0].levelname, vars(lines(caplog)[0])["code"]) == ("INFO", "not_ready")
    (reason,) = [record for record in caplog.records if record.getMessage().startswith("not ready:")]
    assert reason.levelname == level


def test_json_lines_carry_every_field() -> None:
    out = io.StringIO()
    handler = logging.StreamHandler(out)
    handler.addFilter(AddRequestId())
    handler.setFormatter(formatter("json"))
    logger = logging.getLogger("pliant.test-json")
    logger.propagate = False
    logger.addHandler(handler)
    REQUEST_ID.set("id-1")
    logger.warning("two %s", "words", extra={"job": "j1", "status": 404})
    found = json.loads(out.getvalue())
    assert found.pop("time")[:2] == "20"
    assert found == {
        "level": "WARNING", "logger": "pliant.test-json", "message": "two words", "request_id": "id-1", "job": "j1",
        "status": 404,
    }  # fmt: skip


def test_configure_logging_sets_level_and_format(capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    try:
        configure_logging("warning", "console")
        logging.getLogger("pliant.test").info("quiet")
        logging.getLogger("pliant.test").warning("loud")
        printed = capsys.readouterr().err
        assert "quiet" not in printed
        assert printed.endswith("WARNING pliant.test [-]: loud\n") or "pliant.test [" in printed
    finally:
        root.handlers[:] = before
        root.setLevel(level)
