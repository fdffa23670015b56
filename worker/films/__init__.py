"""Films as input: checked when they are submitted, tracked when the job runs, and decoded in a contained process only."""
