"""Job records, queue, blob store, job execution, file formats and supervisor; the only package that imports Redis and RQ."""

if __name__ != "pliant.worker":
    raise ImportError(f"import this folder as pliant.worker, not as {__name__!r}: install it with pip install -e .")
