"""The Helm chart, rendered by Helm itself: objects match the Kubernetes schemas and start commands that exist."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from deployments import read_variables, starts
from pliant.worker.tokens import _FORM

ROOT = Path(__file__).parents[2]
CHART = ROOT / "deploy" / "helm" / "pliant"
KUBERNETES = "1.30"
S3 = {"storage": {"type": "s3", "s3": {"url": "s3://bucket/prefix", "endpoint": "http://minio:9000", "region": "us-east-1",
                                       "existingSecret": "aws"}}}  # fmt: skip
EVERYTHING = {
    **S3, "api": {"replicas": 3, "allowedHosts": "pliant.example.org"}, "keda": {"enabled": True},
    "ingress": {"enabled": True, "host": "pliant.example.org", "tlsSecret": "tls", "className": "nginx"},
    "serviceMonitor": {"enabled": True}, "settings": {"PLIANT_RETENTION": "604800"},
    "serviceAccount": {"annotations": {"role": "arn"}}, "nodeSelector": {"disk": "ssd"},
    "tolerations": [{"key": "k", "operator": "Exists"}], "imagePullSecrets": [{"name": "registry"}],
}  # fmt: skip
EXTERNAL = {
    "valkey": {"enabled": False},
    "redis": {"existingSecret": "redis"},
    "firstToken": {"existingSecret": "mine"},
}
VALUES: dict[str, dict[str, Any]] = {"usual": {}, "everything": EVERYTHING, "external": {**S3, **EXTERNAL}}


def helm() -> Any:
    """Return Helm, which a PyPI package provides for Linux and macOS."""
    if os.environ.get("CI"):
        import helm_python.chart as module
    else:
        module = pytest.importorskip("helm_python.chart", reason="no Helm here: pip install helm-python-sdk")
    return module


def rendered(values: dict[str, Any]) -> list[dict[str, Any]]:
    with helm().Chart.load(CHART) as chart:
        texts = chart.render(values, name="demo", namespace="ns", is_install=True)
    return [each for name, text in texts.items() if name.endswith(".yaml") for each in yaml.safe_load_all(text) if each]


@pytest.fixture(scope="module", params=VALUES)
def objects(request: pytest.FixtureRequest) -> list[dict[str, Any]]:
    return rendered(VALUES[request.param])


def of(objects: list[dict[str, Any]], kind: str) -> dict[str, dict[str, Any]]:
    return {each["metadata"]["name"]: each for each in objects if each["kind"] == kind}


def pods(objects: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {
        name: each["spec"]["template"]
        for kind in ("Deployment", "StatefulSet")
        for name, each in of(objects, kind).items()
    }


def containers(objects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    specs = [pod["spec"] for pod in pods(objects).values()]
    return [each for spec in specs for each in (*spec["containers"], *spec.get("initContainers", ()))]


def test_the_schema_describes_every_value() -> None:
    def check(values: dict[str, Any], schema: dict[str, Any]) -> None:
        for name, value in values.items():
            assert name in schema["properties"], name
            if isinstance(value, dict) and "properties" in schema["properties"][name]:
                assert schema["properties"][name]["additionalProperties"] is False, name
                check(value, schema["properties"][name])

    schema = json.loads((CHART / "values.schema.json").read_text())
    check(yaml.safe_load((CHART / "values.yaml").read_text()), schema)


def test_helm_lint_passes() -> None:
    report = helm().lint(CHART, strict=True)
    assert report["errors"] == []
    assert {message["error"] for message in report["messages"]} <= {"icon is recommended"}


def test_every_object_matches_the_kubernetes_schemas(objects: list[dict[str, Any]]) -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate")
    checked = 0
    for each in objects:
        if each["apiVersion"].startswith(("keda.sh/", "monitoring.coreos.com/")):
            continue  # custom resources; the tests below check them
        validate.validate(each, KUBERNETES, strict=True)
        checked += 1
    assert checked >= 7


def test_the_schema_validation_detects_a_misspelt_field() -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="pip install kubernetes-validate")
    wrong = of(rendered({}), "Deployment")["demo-api"]
    wrong["spec"]["template"]["spec"]["containers"][0]["livenes"] = {}
    with pytest.raises(validate.ValidationError):
        validate.validate(wrong, KUBERNETES, strict=True)


def test_containers_run_existing_commands_with_known_variables(objects: list[dict[str, Any]]) -> None:
    ours = [each for each in containers(objects) if each["image"].startswith("pliant:")]
    assert {each["name"] for each in ours} == {"api", "first-token", "worker", "reconciler"}
    for each in ours:
        command = each["command"]
        assert command[:3] == ["pliant", "token", "create"] or starts(command)
        names = {variable["name"] for variable in each["env"]}
        assert {name for name in names if name.startswith("PLIANT_")} <= read_variables()
    assert {each["command"][3] for each in ours if each["command"][2] == "pliant.worker"} == {"work", "reconcile"}


def test_containers_run_with_least_privilege(objects: list[dict[str, Any]]) -> None:
    for name, pod in pods(objects).items():
        assert pod["spec"]["securityContext"]["runAsNonRoot"] is True, name
        assert pod["spec"]["automountServiceAccountToken"] is False
    for each in containers(objects):
        assert each["securityContext"] == {
            "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
        }  # fmt: skip
        assert "memory" in each["resources"]["limits"]
        assert "startupProbe" in each or each["name"] == "first-token"


def test_settings_replace_defaults_and_none_of_the_variables_that_the_chart_sets() -> None:
    """Kubernetes may refuse a list that names a variable twice, and of two values only the last one has an effect."""
    console = rendered({"settings": {"PLIANT_LOG_FORMAT": "console"}})
    for each in containers(console):
        values = [variable["value"] for variable in each["env"] if variable["name"] == "PLIANT_LOG_FORMAT"]
        assert values == (["console"] if each["image"].startswith("pliant:") else [])
    own = {variable["name"] for each in containers(rendered(EVERYTHING)) for variable in each["env"]}
    for name in {name for name in own if name.startswith("PLIANT_")} - {"PLIANT_LOG_FORMAT", "PLIANT_RETENTION"}:
        with pytest.raises(Exception, match=f"settings.{name}: the chart sets this variable itself"):
            rendered({"settings": {name: "1"}})


def test_annotations_of_the_ingress_replace_the_usual_ones() -> None:
    def passed(annotations: dict[str, str]) -> dict[str, str]:
        values = {"ingress": {"enabled": True, "host": "pliant.example.org", "annotations": annotations}}
        with helm().Chart.load(CHART) as chart:
            text = chart.render(values, name="demo", namespace="ns")["pliant/templates/rest.yaml"]
        assert text.count("proxy-read-timeout") == 1, "a mapping with a name twice is refused by many tools"
        (ingress,) = (each for each in yaml.safe_load_all(text) if each and each["kind"] == "Ingress")
        return {name.rpartition("/")[2]: value for name, value in ingress["metadata"]["annotations"].items()}

    usual = {
        "proxy-body-size": "0", "proxy-request-buffering": "off", "proxy-buffering": "off", "proxy-read-timeout": "120",
    }  # fmt: skip
    assert passed({}) == usual
    longer = passed({"nginx.ingress.kubernetes.io/proxy-read-timeout": "300", "example.org/team": "motion"})
    assert longer == {**usual, "proxy-read-timeout": "300", "team": "motion"}


def test_selectors_match_their_pods_and_mounted_volumes_exist(objects: list[dict[str, Any]]) -> None:
    labels = {name: pod["metadata"]["labels"] for name, pod in pods(objects).items()}

    def found(selector: dict[str, str]) -> list[str]:
        return [name for name, held in labels.items() if selector.items() <= held.items()]

    for kind in ("Deployment", "StatefulSet", "PodDisruptionBudget"):
        for name, each in of(objects, kind).items():
            assert found(each["spec"]["selector"]["matchLabels"]) == [name]
    services = of(objects, "Service")
    assert found(services["demo"]["spec"]["selector"]) == ["demo-api"]
    for pod in pods(objects).values():
        volumes = {each["name"] for each in pod["spec"].get("volumes", ())}
        volumes |= {"data"} if "valkey" in str(pod["metadata"]["labels"]) else set()
        for each in (*pod["spec"]["containers"], *pod["spec"].get("initContainers", ())):
            assert {mount["name"] for mount in each["volumeMounts"]} <= volumes


def test_workers_have_time_to_drain_before_termination(objects: list[dict[str, Any]]) -> None:
    pod = pods(objects)["demo-worker"]["spec"]
    grace = next(each["value"] for each in pod["containers"][0]["env"] if each["name"] == "PLIANT_STOP_GRACE")
    assert pod["terminationGracePeriodSeconds"] > int(grace) + 20


def test_uploads_are_on_the_volume_that_all_pods_share() -> None:
    for each in containers(rendered({})):
        held = {mount["mountPath"]: mount for mount in each["volumeMounts"]}
        if each["name"] != "valkey":
            assert held["/data/uploads"] == {"name": "shared", "mountPath": "/data/uploads", "subPath": "uploads"}
    assert "subPath" not in str(containers(rendered(S3)))


def test_the_inputs_that_the_api_reads_at_once_fit_its_memory() -> None:
    (api,) = (each for each in containers(rendered({})) if each["name"] == "api")
    env = {each["name"]: each.get("value") for each in api["env"]}
    assert api["resources"]["limits"]["memory"] == "4Gi"
    assert int(env["PLIANT_PARSERS"]) * int(env["PLIANT_READ_MEMORY"]) + 2**30 <= 4 * 2**30


def test_valkey_replaces_its_shell_and_reads_the_password_from_its_input(tmp_path: Path) -> None:
    (valkey,) = (each for each in containers(rendered({})) if each["name"] == "valkey")
    server = tmp_path / "valkey-server"
    server.write_text('#!/bin/sh\necho "$$" "$@"\ncat\n')
    server.chmod(0o700)
    env = {"PATH": f"{tmp_path}:{os.defpath}", "REDISCLI_AUTH": "secret"}
    with subprocess.Popen(valkey["command"], env=env, stdout=subprocess.PIPE, text=True) as started:
        told = started.communicate(timeout=20)[0].splitlines()
    arguments, *configuration = told
    assert arguments.split()[:2] == [str(started.pid), "-"], "the process that receives SIGTERM"
    assert configuration == ["requirepass secret"]
    assert "secret" not in arguments
    assert "--appendfsync always" in arguments
    bound = int(re.findall(r"--maxmemory (\d+)mb", arguments)[0])
    assert valkey["resources"]["limits"]["memory"] == "1Gi"
    assert 0.5 < bound / 1024 < 0.75


def test_workers_are_scaled_by_queued_and_running_jobs() -> None:
    objects = rendered(EVERYTHING)
    (scaled,) = of(objects, "ScaledObject").values()
    assert "replicas" not in of(objects, "Deployment")["demo-worker"]["spec"], "two would fight over the number"
    (trigger,) = scaled["spec"]["triggers"]
    query = trigger["metadata"]["query"]
    assert (trigger["type"], trigger["metadata"]["threshold"]) == ("prometheus", "1")
    assert trigger["metadata"]["ignoreNullValues"] == "false", "without metrics, the workers stay as they are"
    assert re.search(r'pliant_jobs\{namespace="ns", status=~"queued\|running\|cancelling"\}', query)
    assert "pliant_queue_depth" not in query, "the queue is empty while jobs run, which would end them"
    assert of(rendered({}), "ScaledObject") == {}


def test_the_generated_token_and_redis_url_are_well_formed(tmp_path: Path) -> None:
    objects = rendered({})
    assert _FORM.fullmatch(of(objects, "Secret")["demo-token"]["stringData"]["token"])
    url = of(objects, "Secret")["demo-redis"]["stringData"]["url"]
    assert re.fullmatch(r"redis://:\w{40}@demo-valkey:6379/0", url)
    assert of(rendered({**S3, **EXTERNAL}), "Secret") == {}


def test_a_backup_can_be_restored_before_api_and_reconciler_start() -> None:
    """The API's pod creates the first token, and only an installation without tokens can be restored."""
    values = {"api": {"replicas": 0}, "worker": {"replicas": 0}}
    with helm().Chart.load(CHART) as chart:
        chart.validate_schema(values)
    stopped = {name: each["spec"]["replicas"] for name, each in of(rendered(values), "Deployment").items()}
    assert stopped == {"demo-api": 0, "demo-worker": 0, "demo-reconciler": 0}
    usual = of(rendered({"api": {"replicas": 3}}), "Deployment")
    assert usual["demo-reconciler"]["spec"]["replicas"] == 1


def test_given_secrets_replace_those_that_every_rendering_makes_anew() -> None:
    """Tools that render the chart without the cluster would set another password at every synchronisation."""
    objects = rendered({"redis": {"existingSecret": "mine"}, "firstToken": {"existingSecret": "token"}})
    assert of(objects, "Secret") == {}
    used = {
        (variable["name"], variable["valueFrom"]["secretKeyRef"]["name"], variable["valueFrom"]["secretKeyRef"]["key"])
        for each in containers(objects)
        for variable in each["env"]
        if "valueFrom" in variable
    }
    assert used == {("PLIANT_REDIS_URL", "mine", "url"), ("REDISCLI_AUTH", "mine", "password")}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"valkey": {"enabled": False}}, "redis.existingSecret"),
        ({"storage": {"type": "s3"}}, "storage.s3.url"),
        ({"storage": {"type": "nfs"}}, "storage"),
        ({"settings": {"RETENTION": "1"}}, "'RETENTION' does not match"),
        ({"ingress": {"enable": True}}, "additional properties 'enable' not allowed"),
        ({"storage": {"s3": {"endpont": "http://minio:9000"}}}, "additional properties 'endpont' not allowed"),
        ({"workers": {"replicas": 2}}, "additional properties 'workers' not allowed"),
        ({"ingress": {"annotations": {"nginx.ingress.kubernetes.io/proxy-read-timeout": 300}}}, "want string"),
        ({"valkey": {"maxmemory": "60%"}}, "'60%' does not match"),
        ({"api": {"replicas": 2}, "storage": {"pvc": {"accessMode": "ReadWriteOnce"}}}, "ReadWriteMany"),
    ],
)
def test_invalid_chart_values_are_refused(values: dict[str, Any], words: str) -> None:
    from helm_python.errors import HelmError

    def render() -> None:
        with helm().Chart.load(CHART) as chart:
            chart.validate_schema(values)
            chart.render(values, name="demo", namespace="ns")

    with pytest.raises(HelmError, match=re.escape(words)):
        render()
