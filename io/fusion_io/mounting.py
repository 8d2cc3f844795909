"""How sensors are mounted to each other, from static transforms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from fusion_io.messages import FrameTransform


def rotation_between(transforms: Sequence[FrameTransform], target: str, source: str) -> Rotation | None:
    """``R_target_source``, composed along the tree of transforms, or None if they are not connected.

    Of two transforms to the same child the later holds.
    """
    to_source = {source: Rotation.identity()}  # R_frame_source of the frames reached so far
    edges = {transform.child: transform for transform in transforms}.values()
    grows = True
    while grows and target not in to_source:
        reached = len(to_source)
        for edge in edges:
            if not np.any(edge.pose.quat_wxyz):
                continue
            R_parent_child = Rotation.from_quat(edge.pose.quat_wxyz, scalar_first=True)
            if edge.child in to_source and edge.parent not in to_source:
                to_source[edge.parent] = R_parent_child * to_source[edge.child]
            elif edge.parent in to_source and edge.child not in to_source:
                to_source[edge.child] = R_parent_child.inv() * to_source[edge.parent]
        grows = len(to_source) > reached
    return to_source.get(target)
