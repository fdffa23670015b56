# Generated from client/_async/__init__.py by `make client`. Edit that file instead.
