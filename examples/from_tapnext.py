"""Reconstruct the output of TAPNext or TAPIR, converted from the model's 256 × 256 input to the film's pixels.

    python examples/from_tapnext.py TRACKS.npz WIDTHxHEIGHT [OUT.glb]

WIDTHxHEIGHT is the film's size. TRACKS.npz contains the model's arrays, saved in the tracking script. TAPNext, with coordinates y, x:
``np.savez("tracks.npz", tracks=tracks, visible_logits=visible_logits)`` with shapes (B, T, N, 2) and (B, T, N, 1). TAPIR and BootsTAPIR:
``np.savez("tracks.npz", tracks=tracks, occlusion=occlusion, expected_dist=expected_dist)`` with (B, N, T, 2), (B, N, T) and (B, N, T).
"""

import sys

import numpy as np
from pliant import Client
from pliant.client.progress import progress_bar

MODEL_SIZE = 256  # side of the model's input picture in pixels; change it if yours differs

if len(sys.argv) < 3:
    sys.exit(__doc__)
source, size = sys.argv[1], sys.argv[2]
target = sys.argv[3] if len(sys.argv) > 3 else "tapnext.glb"
width, height = (int(side) for side in size.split("x"))
arrays = dict(np.load(source))

tracks = np.asarray(arrays["tracks"], dtype=np.float64)
if "visible_logits" in arrays:  # TAPNext returns y, x
    tracks = tracks[..., ::-1]
# The film was stretched to a square, so each axis has its own scale. Positions are measured from the picture's corner.
arrays["tracks"] = tracks * (width / MODEL_SIZE, height / MODEL_SIZE) - 0.5

with Client() as client, progress_bar() as bar:
    options = {"image_size": size, "coordinates": "pixels", "coordinate_order": "xy"}
    job = client.submit(arrays, name="tapnext", options=options, on_upload=bar.on_upload)
    print("read as:", job.record.interpretation.format, job.record.interpretation.layout)
    result = job.wait(on_progress=bar.on_progress, timeout=3600)
    print("shapes", result.shapes.shape, "saved as", result.save_glb(target))
for warning in result.job.warnings:
    print("note:", warning)
