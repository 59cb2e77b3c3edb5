"""Static transforms between the frames of the vehicle: where each sensor is mounted."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from schemas.messages import Transform


class TransformTree:
    """Frames with their parents, as logged on /tf_static (and /tf, for stacks that log mounts there)."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}  # child -> parent, parent_from_child
        self._moving: set[str] = set()  # children whose transform has changed
        self._resolved: dict[tuple[str, str], NDArray[np.float64] | None] = {}

    @property
    def frames(self) -> list[str]:
        """All frame names, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def ancestors(self, frame: str) -> list[str]:
        """Returns the frame itself and what it is fixed to, step by step, up to the root."""
        return list(self._ancestors(frame))

    def add(self, transform: Transform) -> None:
        """Takes one transform; a newer one of the same child replaces the older."""
        parent_from_child = np.eye(4)
        parent_from_child[:3, :3] = Rotation.from_quat(transform.quaternion_xyzw).as_matrix()
        parent_from_child[:3, 3] = transform.translation_m
        child, known = transform.child_frame_id, self._parents.get(transform.child_frame_id)
        if known is not None:
            if known[0] == transform.parent_frame_id and np.array_equal(known[1], parent_from_child):
                return  # a mount, logged again and again
            self._moving.add(child)
        self._parents[child] = (transform.parent_frame_id, parent_from_child)
        self._resolved.clear()

    def moves(self, frame: str) -> bool:
        """Tells whether a frame has ever changed its place in its parent."""
        return frame in self._moving

    def is_fixed(self, frame: str, vehicle: str) -> bool:
        """Tells whether a frame goes where the vehicle's goes: it hangs from it, or nothing between them ever moved."""
        above, beside = self.ancestors(vehicle), self.ancestors(frame)
        if vehicle in beside:
            return True
        joined = next((ancestor for ancestor in beside if ancestor in above), None)
        if joined is None:
            return False
        return not any(self.moves(link) for path in (above, beside) for link in path[: path.index(joined)])

    def transform(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Returns target_from_source (4, 4), through the nearest common ancestor; None if the frames are not joined."""
        if (target, source) not in self._resolved:
            self._resolved[target, source] = self._resolve(target, source)
        return self._resolved[target, source]

    def _resolve(self, target: str, source: str) -> NDArray[np.float64] | None:
        from_target, from_source = self._ancestors(target), self._ancestors(source)
        for ancestor, ancestor_from_source in from_source.items():
            if ancestor in from_target:
                return np.asarray(np.linalg.inv(from_target[ancestor]) @ ancestor_from_source)
        return None

    def _ancestors(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """Returns ancestor_from_frame for the frame itself and each ancestor, nearest first; stops at a circle."""
        found = {frame: np.eye(4)}
        while frame in self._parents:
            parent, parent_from_frame = self._parents[frame]
            if parent in found:
                break
            found[parent] = parent_from_frame @ found[frame]
            frame = parent
        return found
