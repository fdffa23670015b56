"""Check the options of a film, and choose its shot and template."""
