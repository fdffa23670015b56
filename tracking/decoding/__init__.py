"""Open films and decode them frame by frame, after checking what they are."""
