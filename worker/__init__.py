"""The only home of RQ and Redis: queue, job records, blob store, the job itself, artifacts, supervisor."""

if __name__ != "pliant.worker":
    raise ImportError(f"import this folder as pliant.worker, not as {__name__!r}: install it with pip install -e .")
