"""A service in memory, for the tests of programs that use the SDK.

``Client("http://pliant.test", transport=FakeService())`` speaks the whole wire contract without a network, a queue or a solver.
It passes the same tests as the real service (`tests/client/test_contract.py`). What it does not do is reconstruct: its shapes
are the given points with depth 0, or whatever the function says that you give it.
"""

from pliant.client.testing.service import FakeService, Reconstruct, flat

__all__ = ["FakeService", "Reconstruct", "flat"]
