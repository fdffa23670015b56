"""A small Prometheus: evaluates PromQL, parsed by promql-parser, on scrapes of a service's /metrics.

It supports the PromQL that the dashboard and the alert rules use. Rates are taken between the first and the last scrape of the window,
without Prometheus' extrapolation to its ends.
"""

from __future__ import annotations

import math
import operator
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import promql_parser as promql
from prometheus_client.parser import text_string_to_metric_families

Labels = frozenset[tuple[str, str]]
Vector = dict[Labels, float]

OPERATORS: dict[str, Callable[[float, float], float]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul,
    "/": lambda left, right: left / right if right else math.nan,
}  # fmt: skip
COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "==": operator.eq, "!=": operator.ne, ">": operator.gt, "<": operator.lt, ">=": operator.ge, "<=": operator.le,
}  # fmt: skip
AGGREGATES: dict[str, Callable[[list[float]], float]] = {"sum": sum, "max": max, "min": min}


@dataclass
class Prometheus:
    """The scrapes so far, and since when each alert's condition has held."""

    scrapes: list[tuple[float, dict[str, Vector]]] = field(default_factory=list)
    """Seconds, and the samples by the metric's name."""
    pending: dict[str, float] = field(default_factory=dict)

    def scrape(self, text: str, *, at: float) -> None:
        """Store the output of /metrics at a time in seconds."""
        samples: dict[str, Vector] = defaultdict(dict)
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                samples[sample.name][frozenset(sample.labels.items())] = sample.value
        self.scrapes.append((at, samples))

    def query(self, text: str) -> Vector:
        """Evaluate an expression at the last scrape."""
        value = self._value(promql.parse(text))
        assert isinstance(value, dict), f"{text} is a scalar"
        return value

    def firing(self, rules: list[Mapping[str, Any]]) -> set[str]:
        """Evaluate alert rules at the last scrape, after doing so at each earlier one, and return those that fire."""
        now, fired = self.scrapes[-1][0], set()
        for rule in rules:
            name = rule["alert"]
            if not self.query(rule["expr"]):
                self.pending.pop(name, None)
                continue
            since = self.pending.setdefault(name, now)
            held = promql.parse_duration(rule["for"]).total_seconds() if "for" in rule else 0.0
            if now - since >= held:
                fired.add(name)
        return fired

    def _value(self, node: Any) -> Vector | float:
        if isinstance(node, promql.NumberLiteral):
            return float(node.val)
        if isinstance(node, promql.ParenExpr):
            return self._value(node.expr)
        if isinstance(node, promql.VectorSelector):
            return select(self.scrapes[-1][1], node)
        if isinstance(node, promql.AggregateExpr):
            return self._aggregate(node)
        if isinstance(node, promql.Call):
            return self._call(node)
        assert isinstance(node, promql.BinaryExpr), f"not evaluated: {type(node).__name__}"
        left, right = self._value(node.lhs), self._value(node.rhs)
        if str(node.op) == "and":
            form = re.fullmatch(r"on \((\w*)\)", str(node.modifier).strip())
            assert form is not None, f"not evaluated: and {node.modifier}"
            assert isinstance(left, dict)
            assert isinstance(right, dict)
            matched = {dict(labels).get(form[1]) for labels in right}
            return {labels: value for labels, value in left.items() if dict(labels).get(form[1]) in matched}
        return binary(str(node.op), left, right)

    def _aggregate(self, node: Any) -> Vector:
        groups: dict[Labels, list[float]] = defaultdict(list)
        kept = set(node.modifier.labels) if node.modifier is not None else set()
        values = self._value(node.expr)
        assert isinstance(values, dict)
        for labels, value in values.items():
            groups[frozenset(each for each in labels if each[0] in kept)].append(value)
        return {labels: AGGREGATES[str(node.op)](group) for labels, group in groups.items()}

    def _call(self, node: Any) -> Vector:
        name = node.func.name
        if name == "histogram_quantile":
            buckets = self._value(node.args[1])
            assert isinstance(buckets, dict)
            return quantile(float(node.args[0].val), buckets)
        if name == "absent":
            return {} if self._value(node.args[0]) else {frozenset(): 1.0}
        assert name in ("rate", "increase"), f"not evaluated: {name}"
        selector, window = node.args[0].vector_selector, node.args[0].range.total_seconds()
        end = self.scrapes[-1][0]
        inside = [(at, select(samples, selector)) for at, samples in self.scrapes if at >= end - window]
        found: Vector = {}
        for labels in inside[-1][1]:
            points = [(at, vector[labels]) for at, vector in inside if labels in vector]
            if len(points) < 2:
                continue  # as Prometheus: one sample has no rate
            grown = sum(max(0.0, after - before) for (_, before), (_, after) in pairwise(points))
            found[labels] = grown / (points[-1][0] - points[0][0]) if name == "rate" else grown
        return found


def select(samples: Mapping[str, Vector], selector: Any) -> Vector:
    """Return the series of a selector."""
    found = samples.get(selector.name, {})
    return {
        labels: value
        for labels, value in found.items()
        if all(_holds(each, dict(labels)) for each in selector.matchers.matchers)
    }


def _holds(matcher: Any, labels: Mapping[str, str]) -> bool:
    value, kind = labels.get(matcher.name, ""), str(matcher.op).rpartition(".")[2]
    if kind in ("Equal", "NotEqual"):
        return (value == matcher.value) is (kind == "Equal")
    assert kind in ("Re", "NotRe"), kind
    return (re.fullmatch(matcher.value, value) is not None) is (kind == "Re")


def binary(sign: str, left: Vector | float, right: Vector | float) -> Vector:
    """Return an arithmetic result, or the elements of the left side for which a comparison holds."""
    assert isinstance(left, dict)
    found: Vector = {}
    for labels, value in left.items():
        other = right if isinstance(right, float) else right.get(labels)
        if other is None:
            continue
        if sign in OPERATORS:
            found[labels] = OPERATORS[sign](value, other)
        elif COMPARISONS[sign](value, other):
            found[labels] = value
    return found


def quantile(share: float, buckets: Vector) -> Vector:
    """Return the quantile of each histogram, interpolated linearly within its bucket."""
    histograms: dict[Labels, list[tuple[float, float]]] = defaultdict(list)
    for labels, count in buckets.items():
        bound = float(dict(labels)["le"])
        histograms[frozenset(each for each in labels if each[0] != "le")].append((bound, count))
    found: Vector = {}
    for labels, points in histograms.items():
        points.sort()
        total = points[-1][1]
        low, below = 0.0, 0.0
        for bound, count in points:
            if total > 0 and count >= share * total:
                inside = (share * total - below) / (count - below) if count > below else 1.0
                found[labels] = low if math.isinf(bound) else low + (bound - low) * inside
                break
            low, below = bound, count
    return found
