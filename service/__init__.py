"""The HTTP service: parse, call, answer. It never solves."""

if __name__ != "pliant.service":
    raise ImportError(f"import this folder as pliant.service, not as {__name__!r}: install it with pip install -e .")
