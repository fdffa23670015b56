"""The built-in examples can be submitted as they are served."""

from __future__ import annotations

import httpx
import pytest


def test_a_listed_example_can_be_submitted(http: httpx.Client) -> None:
    listed = http.get("/v1/examples").json()["examples"]
    assert {one["name"] for one in listed} >= {"face", "flag", "sphere"}
    sphere = next(one for one in listed if one["name"] == "sphere")
    files = {one["part"]: http.get(one["url"]).content for one in sphere["files"]}
    answer = http.post("/v1/jobs", files=files)
    assert answer.status_code == 202
    seen = answer.json()["interpretation"]
    assert (seen["num_frames"], seen["num_points"], seen["has_ground_truth"]) == (30, 500, True)


@pytest.mark.parametrize("address", ["/v1/examples/absent/tracks.npz", "/v1/examples/face/absent.npz"])
def test_an_unknown_example_returns_404_and_lists_known_ones(http: httpx.Client, address: str) -> None:
    answer = http.get(address)
    assert answer.status_code == 404
    assert answer.json()["code"] == "unknown_example"
    assert "face/tracks.npz" in answer.json()["detail"]
