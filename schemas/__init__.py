"""The wire contract: options, jobs and problem documents as Pydantic models. Imports nothing else of Pliant."""

if __name__ != "pliant.schemas":
    raise ImportError(f"import this folder as pliant.schemas, not as {__name__!r}: install it with pip install -e .")
