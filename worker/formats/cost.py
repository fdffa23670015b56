"""Estimate a job's memory, time and result files from its size before it runs.

Memory is a constant for the interpreter and the libraries plus an amount per observation (F·P), since the arrays of the solver and of the
exporters are linear in them; but where the prior is not learned, cameras are factorized from the Gram matrix of all frames. Time is a
constant plus an amount per frame, for cameras and prior, and an amount per observation.

Basis: whole jobs with the default options and outputs on one core, gallery faces (`python -m benchmarks.installation.cost`), with both
cores of the machine busy; in a quiet hour 100 × 500 took 12.4 s.

    frames × points   peak, MB   estimate   processor, s   estimate
    10 × 500               108        112            3.6        2.5
    10 × 5,000             125        128            4.5        2.9
    10 × 40,000            270        250           10.0        5.7
    50 × 500               132        119           13.2       10.7
    50 × 2,000             154        145           14.1       11.3
    50 × 10,000            294        285           18.9       14.5
    100 × 500              161        128           20.2       20.9
    100 × 2,000            201        180           30.9       22.1
    200 × 500              183        145           77.6       41.3

With other options, the solver alone, processor s (estimate); the constants were chosen on the first size:

    frames × points   smooth prior   given rotations   both
    50 × 500             2.4 (3.0)         2.0 (3.0)   .4 (1.0)
    10 × 500              .7 (1.0)          .5 (1.0)
    100 × 500            5.2 (5.4)         4.4 (5.4)
    30 × 5,000           2.1 (3.1)         2.2 (3.1)   .8 (1.9)
    1,000 × 300           15 (19)
    3,000 × 300           47 (46)                      30 (36)

3,000 × 300 took 1.1 GB with the smooth prior (estimate 1.2), .3 GB with given scales, too.

With `image_size`, the solver alone, processor s, noise of .5 px (`python -m benchmarks.installation.cost --near`, in the same hour):

    frames × points   near   near, 20 % hidden   far, 20 % hidden   estimate
    30 × 300          18.5                16.8               10.8       13.1
    30 × 1,500        23.1                18.6               14.9       13.4
    60 × 500          20.2                29.1               19.2       19.7
    120 × 1,000       37.9                47.0               33.1       32.5

Tracks that resemble those of a sheet take more, for the test for an isometric surface: processor s of the solver alone with `surface=free`,
and with `auto` (estimate), of films of faces as tracked:

    frames × points   free   auto   estimate
    12 × 1,819         4.8   19.6        5.7
    16 × 2,231         5.9   15.5        7.5
    30 × 2,307        11.3   40.9       13.6

Tracks of a sheet take the times below instead, which only the test can tell unless `surface=isometric` is set: the solver alone,
processor s, made-up paper that the camera goes half round. Without the option, the estimates of the last three are 49.5, 48.2 and 57.2 s.

    frames × points   processor, s   estimate
    20 × 144                  10.5        12.8
    60 × 144                  14.9        19.2
    150 × 144                 16.2        25.1
    150 × 10,000              25.6        31.1
    600 × 144                 27.1        54.6
    3,000 × 144              132.7       212.0

With blocks of larger overlap, the solver alone took 11.6 GB and 520 processor seconds for 100 × 1,000,000, estimated at 17 GB and 821 s.
Not covered: sparsely observed points, which take 80 bytes times the square of their number; and time with other options.
"""

from __future__ import annotations

from bisect import bisect_right

from pliant.schemas.job import Estimate, Interpretation
from pliant.schemas.options import Options
from pliant.solver.limits import BLOCK_OBSERVATIONS, learned_frames
from pliant.solver.stages import accepted_sheet, search_for_sheet

LIBRARIES = 110_000_000
"""Bytes of a job process before it reads its inputs."""

BYTES = {"gaussian": 350, "smooth": 250, "smooth+low_rank": 350}
"""Bytes per observation, by prior: 230 to 340, 150 to 220 and 330 were measured in whole jobs of 200,000 to 1.2 million observations."""

BEYOND = 150
"""Bytes per observation beyond those solved at once, of which only tracks and results are kept: 80 in the solver, 140 while files are
written, measured in a job with small blocks."""

SECONDS = 0.5
"""Processor seconds of the smallest job."""

LEARNING = {(True, False): 0.2, (True, True): 0.045, (False, False): 0.045, (False, True): 0.005}
"""Processor seconds per frame from which cameras and prior are learned, by (whether the prior is learned, whether rotations are given)."""

FURTHER = 0.01
"""Processor seconds per frame that cameras and prior are not learned from, where the prior is not learned."""

GRAM_BYTES = 96
"""Bytes per squared number of frames, where the prior is not learned: the Gram matrix of the tracks, shape `(2F, 2F)`, and two copies."""

LENS, LENS_FRAMES = 7.0, 32
"""Processor seconds of comparing focal lengths where picture size or lens is known, and the number of frames from which they are compared;
fewer take proportionally less."""

MICROSECONDS = 8.0
"""Processor time per observation."""


FILE_BYTES = {"glb": 26, "ply": 28, "obj": 46, "usd": 25, "abc": 14, "mat": 42, "mdd": 12, "csv": 7}
"""Bytes per observation of the files of each output, measured with faces of 16 × 1,500 and 40 × 1,600 frames × points."""

USUAL_FILE_BYTES = 62
"""The same for the files that every job writes, `shapes.npz` and the preview."""

FILM_POINTS = 4000
"""Number of points of a film that is not tracked yet: the tracker chooses their distance for about as many."""


def expected_files(interpretation: Interpretation, options: Options, *, further: bool = False) -> int:
    """Return about how many bytes the result files will have; `further` is true if they are written from a stored result.

    The number of points of a film is only known once it is tracked.
    """
    points = interpretation.num_points
    if interpretation.mesh_source == "film" and points == 0:
        points = min(FILM_POINTS, options.max_points or FILM_POINTS)
    each = sum(FILE_BYTES[output] for output in options.outputs) + (0 if further else USUAL_FILE_BYTES)
    return interpretation.num_frames * points * each


def estimated(num_frames: int, num_points: int, options: Options, *, has_rotations: bool = False) -> Estimate:
    """Estimate what a job of this size needs; `has_rotations` is true if the cameras are given."""
    observations = num_frames * num_points
    prior = _prior(options)
    learns = prior == "gaussian"
    at_once = int(min(observations, _largest_block(options)))
    used = num_frames if options.order == "any" else learned_frames(num_frames)
    if options.surface == "isometric":
        seconds = sum(
            stage.seconds for stage in [*search_for_sheet(num_frames), *accepted_sheet(num_frames, num_points)]
        )
    else:
        seconds = LEARNING[learns, has_rotations] * used + MICROSECONDS * 1e-6 * observations
        if learns and _may_be_perspective(options):
            seconds += LENS * min(1.0, used / LENS_FRAMES)
        if not learns:
            seconds += FURTHER * (num_frames - used)
    gram = 0 if learns else GRAM_BYTES * num_frames**2
    return Estimate(
        memory_bytes=LIBRARIES + BYTES[prior] * at_once + BEYOND * (observations - at_once) + gram,
        seconds=round(SECONDS + seconds, 1),
    )


def largest_that_fits(memory: int, num_frames: int, num_points: int, options: Options) -> tuple[int, int]:
    """Return the most points at this number of frames, and the most frames at this number of points, that fit into `memory` bytes."""
    sizes = range(1, memory // BEYOND + 2)  # one more observation than any estimate allows
    points = bisect_right(sizes, memory, key=lambda count: estimated(num_frames, count, options).memory_bytes)
    return points, bisect_right(sizes, memory, key=lambda count: estimated(count, num_points, options).memory_bytes)


def _prior(options: Options) -> str:
    """Return the prior that a job uses: the Gaussian one is learned only by the default method and preset."""
    learned = options.method == "robust" and options.preset == "auto"
    return "smooth" if options.prior == "gaussian" and not learned else options.prior


def _may_be_perspective(options: Options) -> bool:
    known = any(each is not None for each in (options.image_size, options.focal, options.field_of_view))
    return options.camera == "perspective" or (options.camera == "auto" and known)


def _largest_block(options: Options) -> float:
    """Return the maximum number of observations solved at once; unlimited with the low-rank prior and the pseudo-inverse."""
    return (
        float("inf") if options.prior == "smooth+low_rank" or options.method == "pseudo_inverse" else BLOCK_OBSERVATIONS
    )
