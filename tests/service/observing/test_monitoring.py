"""The dashboard and the alert rules query only metrics and labels that /metrics exports."""

from __future__ import annotations

import json
import re
from datetime import timedelta
from pathlib import Path

import httpx
import yaml
from pliant.schemas.job import Problem
from pliant.worker.jobs import lifecycle
from prometheus_client.parser import text_string_to_metric_families
from serving import NOW, Running, claim, finish, submit

DEPLOY = Path(__file__).parents[3] / "deploy"
SELECTOR = re.compile(r"(pliant_\w+)(?:\{([^}]*)\})?")
LABEL = re.compile(r"(\w+)\s*(?:=~|=|!=|!~)")
GROUPED = re.compile(r"\bby \(([^)]*)\)")


def queries() -> list[str]:
    rules = yaml.safe_load((DEPLOY / "prometheus" / "alerts.yml").read_text())["groups"][0]["rules"]
    panels = json.loads((DEPLOY / "grafana" / "pliant.json").read_text())["panels"]
    assert len(rules) > 5
    assert all({"summary", "remedy"} <= set(rule["annotations"]) for rule in rules)
    return [rule["expr"] for rule in rules] + [target["expr"] for panel in panels for target in panel["targets"]]


def test_every_query_uses_existing_metrics_and_labels(running: Running, http: httpx.Client) -> None:
    finish(running, submit(http, name="done").id, b"x")
    failed = submit(http, name="failed")
    attempt = claim(running, failed.id)
    problem = Problem(title="T", status=500, detail="It broke.", code="out_of_memory")
    running.jobs.records.update(
        failed.id,
        lambda held: lifecycle.fail(
            held, attempt_id=attempt, problem=problem, now=NOW + timedelta(seconds=7), retention=0
        ),
    )
    labels: dict[str, set[str]] = {}
    families = set()
    for family in text_string_to_metric_families(http.get("/metrics").text):
        families |= {family.name, f"{family.name}_total"} if family.type == "counter" else {family.name}
        for sample in family.samples:
            labels.setdefault(sample.name, set()).update(sample.labels)
    asked = queries()
    assert len(asked) > 15
    for query in asked:
        selectors = SELECTOR.findall(query)
        assert selectors, query
        for name, condition in selectors:
            if name not in labels:  # a counter that has not counted yet
                assert name in families, query
                continue
            assert set(LABEL.findall(condition)) <= labels[name], query
            for group in GROUPED.findall(query):
                # Prometheus adds the namespace when it scrapes.
                assert {each.strip() for each in group.split(",")} <= {*labels[name], "namespace"}, query


def test_every_metric_is_used_by_the_dashboard_or_an_alert(http: httpx.Client) -> None:
    shown = {re.sub(r"_(bucket|total)$", "", name) for query in queries() for name, _ in SELECTOR.findall(query)}
    served = {family.name for family in text_string_to_metric_families(http.get("/metrics").text)}
    assert served == shown
