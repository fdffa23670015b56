"""The wire contract, the SDK and the command line."""

if __name__ != "pliant.client":
    raise ImportError(f"import this folder as pliant.client, not as {__name__!r}: install it with pip install -e .")
