"""What tests of several folders share: one real service, started once, with its queue and one worker, on a free port."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

# A shell that starts the tests in the background has them ignore Ctrl-C, and every process they start inherits that. The tests
# press Ctrl-C on purpose.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def service_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a running service; its jobs compute with one thread, so that their arrays can be compared bit for bit."""
    from pliant.cli.demo import running

    with running(tmp_path_factory.mktemp("service"), threads=1) as url:
        yield url
