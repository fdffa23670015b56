"""Films as input: checked when they are submitted, tracked when the job runs, and decoded only in a contained process."""
