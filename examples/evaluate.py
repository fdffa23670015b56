"""Compare a reconstruction with the ground truth, and plot the error of every frame.

    python examples/evaluate.py TRACKS.npz TRUTH.npz [PLOT.png]

TRUTH.npz contains shapes (F, P, 3). Needs matplotlib.
"""

import sys

import numpy as np
from matplotlib.figure import Figure
from pliant import Client

if len(sys.argv) < 3:
    sys.exit(__doc__)
tracks, truth, target = sys.argv[1], sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else "error.png"

with Client() as client:
    result = client.submit(tracks, ground_truth=truth, name="evaluation").wait(timeout=3600)
for name, value in result.metrics.items():
    print(f"{name:24} {value:.4g}")

# The error of each frame after the best similarity transform. The service reports the mean as e3d_frame_similarity.
true = np.load(truth)["shapes"]
true = true - true.mean(axis=1, keepdims=True)
errors = []
for ours, theirs in zip(result.shapes, true, strict=True):
    left, singular, right = np.linalg.svd(ours.T @ theirs)
    fitted = ours @ left @ right * singular.sum() / (ours**2).sum()
    errors.append(np.linalg.norm(fitted - theirs) / np.linalg.norm(theirs))

figure = Figure(figsize=(7, 3), layout="constrained")
axes = figure.add_subplot(xlabel="frame", ylabel="relative 3-D error", ylim=(0, 1.1 * max(errors)))
axes.plot(errors)
axes.axhline(float(np.mean(errors)), linestyle=":", label=f"mean {np.mean(errors):.3f}")
axes.legend()
figure.savefig(target)
print("plot saved as", target)
