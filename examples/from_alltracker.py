"""Reconstruct AllTracker's output, which has a track for every pixel: use a few thousand of them inside a mask.

    python examples/from_alltracker.py TRACKS.npz MASK.png [OUT.glb]

TRACKS.npz contains AllTracker's arrays, saved in the tracking script with
``np.savez("tracks.npz", traj_maps_e=traj_maps_e.cpu(), visconf_maps_e=visconf_maps_e.cpu())``. Both are (B, T, 2, H, W); the second has
visibility and confidence. MASK.png is white on the subject in the first frame; it is resized to H × W.
"""

import sys

import numpy as np
from PIL import Image
from pliant import Client
from pliant.client.progress import progress_bar

POINTS = 4000  # takes minutes on two cores; more points take longer

if len(sys.argv) < 3:
    sys.exit(__doc__)
source, mask_file = sys.argv[1], sys.argv[2]
target = sys.argv[3] if len(sys.argv) > 3 else "alltracker.glb"
arrays = dict(np.load(source))
maps, certainty = arrays["traj_maps_e"][0], arrays["visconf_maps_e"][0]  # (T, 2, H, W)
height, width = maps.shape[-2:]

# Every n-th row and column inside the mask, so that neighbouring points remain neighbours; -1 where there is no point.
inside = np.asarray(Image.open(mask_file).convert("L").resize((width, height))) >= 128
step = max(1, round(np.sqrt(inside.sum() / POINTS)))
rows, columns = np.arange(0, height, step), np.arange(0, width, step)
chosen = inside[np.ix_(rows, columns)]
grid = np.full(chosen.shape, -1)
grid[chosen] = np.arange(chosen.sum())

cells = np.ix_(rows, columns)
tracks = maps[:, :, *cells][:, :, chosen].transpose(0, 2, 1)
visible = certainty[:, :, *cells][:, :, chosen].prod(axis=1)
visible = np.where(visible >= 0.5, visible, 0)

with Client() as client, progress_bar() as bar:
    job = client.submit(
        tracks,
        visible=visible,
        mesh={"grid": grid},
        name="alltracker",
        options={"image_size": f"{width}x{height}"},
        on_upload=bar.on_upload,
    )
    print("points:", job.record.interpretation.num_points, "one pixel in", step)
    result = job.wait(on_progress=bar.on_progress, timeout=3600)
    print("shapes", result.shapes.shape, "saved as", result.save_glb(target))
for warning in result.job.warnings:
    print("note:", warning)
