"""Bundle adjustment "in the large" (Agarwal et al. 2010): reading the problems, as observations of a free network."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uavkit.core.adjustment import AdjustmentInput
from uavkit.core.angles import rotation_from_vector
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.observations import Rays

DATA = Path(__file__).resolve().parents[2] / "../shared/data/adjustment/bal"
PROBLEMS = {21: "problem-21-11315-pre.txt", 39: "problem-39-18060-pre.txt", 49: "problem-49-7776-pre.txt"}


@dataclass(frozen=True, kw_only=True)
class BalProblem:
    """A problem as it is given: p = f (1 + k1 r2 + k2 r2^2) (-X / Z, -Y / Z), y up, of R x + t."""

    image: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    cameras: np.ndarray
    """(n, 9) rotation vector, translation, f, k1, k2."""
    points: np.ndarray

    @property
    def rotations(self) -> np.ndarray:
        """Return the rotations (n, 3, 3) from object into image space."""
        return rotation_from_vector(self.cameras[:, :3])


def read_bal(images: int) -> BalProblem:
    """Read the problem of so many images."""
    numbers = np.array((DATA / PROBLEMS[images]).read_text(encoding="ascii").split(), dtype=np.float64)
    n, m, k = (int(number) for number in numbers[:3])
    rows, rest = numbers[3 : 3 + 4 * k].reshape(k, 4), numbers[3 + 4 * k :]
    return _before_cameras(
        BalProblem(
            image=rows[:, 0].astype(np.int64),
            point=rows[:, 1].astype(np.int64),
            xy=rows[:, 2:],
            cameras=rest[: 9 * n].reshape(n, 9),
            points=rest[9 * n : 9 * n + 3 * m].reshape(m, 3),
        )
    )


def _before_cameras(problem: BalProblem) -> BalProblem:
    """Return the problem without those few points that lie behind one of their cameras at the start.

    What their rays count is a matter of taste, on which programs differ.
    """
    x = np.einsum("kij,kj->ki", problem.rotations[problem.image], problem.points[problem.point])
    behind = np.zeros(len(problem.points), dtype=bool)
    behind[problem.point[x[:, 2] + problem.cameras[problem.image, 5] >= 0.0]] = True
    keep, new = ~behind[problem.point], np.cumsum(~behind) - 1
    return BalProblem(
        image=problem.image[keep],
        point=new[problem.point[keep]],
        xy=problem.xy[keep],
        cameras=problem.cameras,
        points=problem.points[~behind],
    )


def observations(problem: BalProblem) -> AdjustmentInput:
    """Return the problem with an interior orientation for each image, f, k1 and k2 of which are free."""
    rotations, n = problem.rotations, len(problem.cameras)
    interiors = tuple(
        InteriorOrientation(
            width_px=4000, height_px=3000, principal_distance_px=camera[6], x0_px=0.0, y0_px=0.0,
            k1=camera[7], k2=camera[8],
        )
        for camera in problem.cameras
    )  # fmt: skip
    return AdjustmentInput(
        interior=interiors[0],
        interiors=interiors,
        interior_index=np.arange(n),
        interior_sigmas=InteriorSigmas(principal_distance_px=np.inf, k1=np.inf, k2=np.inf),
        projection_centres_m=-np.einsum("nji,nj->ni", rotations, problem.cameras[:, 3:6]),
        R_object_from_image=rotations.transpose(0, 2, 1).copy(),
        points_m=problem.points,
        rays=Rays(
            image_index=problem.image,
            point_index=problem.point,
            xy_px=problem.xy * [1.0, -1.0],
            sigma_px=np.ones_like(problem.xy),
        ),
    )
