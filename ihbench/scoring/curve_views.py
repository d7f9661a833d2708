"""The few test views on which the quality-time curve is measured: chosen so that they stand for all of them.

How well a test view comes out follows mostly from where its camera stands about the person, from the pose, and from
how much of what it shows was hidden or never seen in training. Views are chosen whose means of these come close to
the means over all views, spread over cameras and frames. Nothing is predicted and no image is read for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.scene.regions import HIDDEN, NEVER_SEEN
from ihbench.scene.spread import spread
from ihbench.scene.views import straight_camera

if TYPE_CHECKING:
    from ihbench.scene.views import TestViewKey
    from ihbench.scoring.scoring import Scorer

SIDE = 64  # px, longer side at which bodies are drawn to count what they show
SHARES_COUNT = 3.0  # weight of the regions' shares beside the camera's direction and the frame: they move scores most
MOST_FRAMES = 64  # posed to choose from, evenly spaced
ROUNDS = 20  # of exchanges; a few do


def curve_views(scorer: Scorer, count: int) -> list[int]:
    """Indices, ascending, of up to `count` of the protocol's own test views; all of them where there are no more."""
    keys = scorer.scene.test_keys
    own = [k for k, key in enumerate(keys) if not key.group]
    if len(own) <= count:
        return own
    frames = sorted({keys[k].frame for k in own})
    looked_at = {frames[k] for k in spread(len(frames), MOST_FRAMES)}
    own = [k for k in own if keys[k].frame in looked_at]
    asked = [keys[k] for k in own]
    traits = _standard(_raw_traits(scorer, asked))
    traits[:, 4:6] *= SHARES_COUNT
    traits = np.concatenate([traits, _standard(traits**2)], 1)  # the spread is matched, too, not only the mean
    chosen = representatives(traits, [key.camera for key in asked], [key.frame for key in asked], count)
    return [own[k] for k in chosen]


def representatives(
    traits: NDArray[np.float64],  # [N, D]
    cameras: Sequence[int],
    frames: Sequence[int],
    count: int,
) -> list[int]:
    """`count` of N views, no camera and no frame more often than it must be, whose mean traits are near the mean.

    Greedy, then exchanged one by one while that helps; of equal choices the first. The same views, the same answer.
    """
    target = traits.mean(0)
    most = [-(-count // len(set(names))) for names in (cameras, frames)]  # of one camera, of one frame

    def best(taken: Sequence[int]) -> tuple[float, int]:
        """Of the views that may join those taken; where the limits leave none, of any other."""
        used = Counter(cameras[k] for k in taken), Counter(frames[k] for k in taken)
        rest = [k for k in range(len(traits)) if k not in taken]
        fair = [k for k in rest if used[0][cameras[k]] < most[0] and used[1][frames[k]] < most[1]]
        candidates = np.array(fair or rest)
        means = (traits[list(taken)].sum(0) + traits[candidates]) / (len(taken) + 1)
        costs = ((means - target) ** 2).sum(1)
        k = int(costs.argmin())
        return float(costs[k]), int(candidates[k])

    chosen: list[int] = []
    for _ in range(count):
        chosen.append(best(chosen)[1])
    cost = float(((traits[chosen].mean(0) - target) ** 2).sum())
    for _ in range(ROUNDS):
        before = cost
        for place in range(count):
            new_cost, k = best(chosen[:place] + chosen[place + 1 :])
            if new_cost < cost * (1 - 1e-9):
                chosen[place], cost = k, new_cost
        if cost == before:
            break
    return sorted(chosen)


def _raw_traits(scorer: Scorer, keys: Sequence[TestViewKey]) -> NDArray[np.float64]:
    """[N, 7] of some test views: the camera's direction (3), the frame, the shares of what is shown that are hidden
    and never seen, and the logarithm of the person's size."""
    scene, body = scorer.scene, scorer.surface.body
    poses, rows = {}, []
    for key in keys:
        camera = straight_camera(scene.capture.camera(key.camera), scene.protocol.image)
        if key.frame not in poses:
            pose = scene.capture.body_pose(key.frame)
            poses[key.frame] = body.pose(pose), axis_angle_to_matrix(pose.pose[0]), body.posed_joints(pose)[0]
        vertices, root, centre = poses[key.frame]
        away = camera.center - centre
        direction = away @ root / max(np.linalg.norm(away), 1e-9)  # in the person's own axes
        scale = SIDE / max(camera.width, camera.height)
        small = camera.scaled(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        labels = scorer.surface.labels_in(vertices, small)
        shown = labels[labels > 0]
        shares = [np.mean(shown == label) if len(shown) else 0.0 for label in (HIDDEN, NEVER_SEEN)]
        size = np.log1p(len(shown))
        rows.append([*direction, key.frame, *shares, size])
    return np.array(rows, np.float64)


def _standard(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, D] about their means, in units of their deviation; 0 where all are the same."""
    spread = values.std(0)
    return (values - values.mean(0)) / np.where(spread > 1e-9, spread, np.inf)
