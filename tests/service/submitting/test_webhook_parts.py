"""The parts `webhook` and `webhook_secret` of a submission."""

from __future__ import annotations

import base64

import httpx
import pytest
from serving import Running, form, tracks

SECRET = "whsec_" + base64.b64encode(b"s" * 32).decode()
PARTS = {"webhook": "https://hooks.example/x?token=private", "webhook_secret": SECRET}


def test_a_webhook_is_stored_with_the_job_and_never_shown(running: Running, http: httpx.Client) -> None:
    answer = http.post("/v1/jobs", files=form(**PARTS))
    assert answer.status_code == 202, answer.text
    id = answer.json()["id"]
    kept = running.jobs.records.get(id).webhook
    assert kept is not None
    assert (kept.url, kept.secret) == tuple(PARTS.values())
    http.post(f"/v1/jobs/{id}/cancel")
    for path in ("", "/log", "/events", "/artifacts"):
        text = http.get(f"/v1/jobs/{id}{path}").text
        assert SECRET not in text
        assert "private" not in text
    assert SECRET not in answer.text
    assert SECRET not in http.get("/v1/jobs").text


@pytest.mark.parametrize(
    ("parts", "code"),
    [
        ({"webhook": "https://hooks.example/"}, "invalid_webhook_secret"),
        ({"webhook_secret": SECRET}, "invalid_webhook"),
        (PARTS | {"webhook": "http://169.254.169.254/latest/meta-data/"}, "webhook_not_public"),
        (PARTS | {"webhook": "http://[::1]:8000/v1/jobs"}, "webhook_not_public"),
        (PARTS | {"webhook": "file:///etc/passwd"}, "invalid_webhook"),
    ],
)
def test_an_invalid_webhook_is_rejected_at_submission(
    running: Running, http: httpx.Client, parts: dict[str, str], code: str
) -> None:
    before = running.waiting
    answer = http.post("/v1/jobs", files=form(**parts))
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert SECRET not in answer.text
    assert running.waiting == before


def test_an_idempotency_key_conflicts_if_the_webhook_differs(http: httpx.Client) -> None:
    body, key = tracks(seed=9), {"Idempotency-Key": "hooked"}
    first = http.post("/v1/jobs", files=form(body, **PARTS), headers=key)
    assert http.post("/v1/jobs", files=form(body, **PARTS), headers=key).json()["id"] == first.json()["id"]
    assert http.post("/v1/jobs", files=form(body), headers=key).status_code == 409
