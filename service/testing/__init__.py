"""The service in memory, for tests of programs that use the SDK.

``Client(transport=InMemoryService())`` runs the real application in this process: the same routes, readers and records, with
in-memory stores, and a thread in place of queue and workers. tests/client/test_contract.py runs with it and with a real service.
"""

from pliant.service.testing.in_memory import InMemoryService
from pliant.service.testing.reconstruction import Reconstruct, flat

__all__ = ["InMemoryService", "Reconstruct", "flat"]
