"""The HTTP service: parse requests, call `pliant.worker`, respond. It never runs the solver."""

if __name__ != "pliant.service":
    raise ImportError(f"import this folder as pliant.service, not as {__name__!r}: install it with pip install -e .")
