"""One wish, asked through one of three clients; what came of it is printed as JSON.

`benchmarks/clients.py` runs this, PyODM and replicate-python under an interpreter that has them: nothing of Pliant is imported then.

    python benchmarks/clients_child.py CLIENT WISH URL [FILE]
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
from pathlib import Path


def pyodm(wish: str, url: str, file: str) -> object:
    from pyodm import Node

    host, port = url.removeprefix("http://").split(":")
    node = Node(host, int(port), token="first-secret" if wish == "token" else "")
    task = node.get_task("job")
    if wish in ("submit", "lost"):
        return node.create_task([file]).uuid
    if wish == "wait":
        return task.wait_for_completion()
    if wish == "failed":
        return task.wait_for_completion()
    if wish == "token":
        node.info()
        return Node(host, int(port)).info().version
    with tempfile.TemporaryDirectory() as folder:
        return Path(task.download_zip(folder)).stat().st_size


def replicate(wish: str, url: str, file: str) -> object:
    from replicate.client import Client
    from replicate.helpers import FileOutput

    client = Client(api_token="first-secret" if wish == "token" else "none", base_url=url)
    if wish == "submit":
        return client.files.create(file).id
    if wish == "lost":
        return client.predictions.create(version="v", input={"a": 1}).id
    if wish in ("wait", "failed"):
        prediction = client.predictions.get("job")
        prediction.wait()
        return prediction.status
    if wish == "token":
        client.predictions.get("job")
        return Client(api_token="none", base_url=url).predictions.get("job").id
    with tempfile.TemporaryFile() as target:
        for piece in FileOutput(f"{url}/file", client):
            target.write(piece)
        return target.tell()


def pliant(wish: str, url: str, file: str) -> object:
    from pliant.client import Client

    client = Client(url, token="first-secret" if wish == "token" else None)
    if wish in ("submit", "lost"):
        return client.submit(file).id
    if wish in ("wait", "failed"):
        return client.wait("job", load=False).job.status
    if wish == "token":
        client.get("job")
        return Client(url).get("job").id
    with tempfile.TemporaryDirectory() as folder:
        return client.download("job", folder, names=["file"])["file"].stat().st_size


def peak() -> float:
    """Return the most memory that this process ever held, in megabytes; `ru_maxrss` would begin with its parent's."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


def main(client: str, wish: str, url: str, file: str) -> None:
    ask = {"pyodm": pyodm, "replicate": replicate, "pliant": pliant}[client]
    ask("token", url, "")  # imports, and first contact: two looks
    before, began = peak(), time.perf_counter()
    try:
        outcome = {"got": str(ask(wish, url, file))}
    except Exception as fault:  # noqa: BLE001 - whatever a client raises is what is measured
        outcome = {"raised": type(fault).__name__, "said": " ".join(str(fault).split())}
    seconds = time.perf_counter() - began
    print(json.dumps({**outcome, "seconds": seconds, "grown_mb": peak() - before}))


if __name__ == "__main__":
    main(*sys.argv[1:4], sys.argv[4] if len(sys.argv) > 4 else "")
