"""Animated glTF: the mesh and its camera."""
