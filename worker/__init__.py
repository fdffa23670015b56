"""Job records, queue, blob store, job execution, readers and writers of files, supervisor: all that uses Redis and RQ."""

if __name__ != "pliant.worker":
    raise ImportError(f"import this folder as pliant.worker, not as {__name__!r}: install it with pip install -e .")
