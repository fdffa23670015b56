"""Reconstruct CoTracker's output: its dictionary is submitted unchanged.

    python examples/from_cotracker.py TRACKS.npz [OUT.glb]

TRACKS.npz contains CoTracker's arrays, saved in the tracking script with
``np.savez("tracks.npz", pred_tracks=pred_tracks.cpu(), pred_visibility=pred_visibility.cpu())``.
"""

import sys

import numpy as np
from pliant import Client
from pliant.client.progress import progress_bar

if len(sys.argv) < 2:
    sys.exit(__doc__)
source, target = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "cotracker.glb"
tracker_output = dict(np.load(source))  # in a tracking script: {"pred_tracks": …, "pred_visibility": …}; tensors, too

with Client() as client, progress_bar() as bar:
    job = client.submit(tracker_output, name="cotracker", on_upload=bar.on_upload)
    print("read as:", job.record.interpretation.layout)
    result = job.wait(on_progress=bar.on_progress, timeout=3600)
    print("shapes", result.shapes.shape, "saved as", result.save_glb(target))
for warning in result.job.warnings:
    print("note:", warning)
