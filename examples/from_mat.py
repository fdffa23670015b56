"""Reconstruct a MATLAB file as used in the literature (W, and optionally S and Rs), and save the shapes.

python examples/from_mat.py FILE.mat [OUT.npz]
"""

import os
import sys

import numpy as np
from pliant import Client

if len(sys.argv) < 2:
    sys.exit(__doc__)
source, target = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "shapes.npz"

with Client() as client:
    # The file is sent unchanged. The service finds W and reports the order of its rows; an ambiguous file is an error.
    result = client.submit(source, mesh="none", name=os.path.basename(source)).wait(timeout=3600)
    print("read as:", result.job.interpretation.layout)
    np.savez_compressed(target, shapes=result.shapes, rotations=result.rotations)
    print(f"{result.shapes.shape[0]} frames × {result.shapes.shape[1]} points saved as {target}")
