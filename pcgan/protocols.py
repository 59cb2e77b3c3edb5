"""The protocols of the paper's two tables: what is trained on, what validates, what is tested.

ETH/UCY: leave one scene out; the other files are cut in time, the first part to train on, the rest to validate.
VCI (DUT): whole clips, 60 % of the trajectories to train on, 20 % to validate, 20 % to test.
And a long task on DUT, which the paper does not have: 4.8 s ahead, on the clips that are held out for replays.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pcgan.clips import RATES_HZ, Clip, clip_names, frames_per_step, load_clip
from pcgan.dataset import (
    HELD_OUT_CLIPS,
    VALIDATION_CLIPS,
    Windows,
    WindowSpec,
    clip_windows,
    concatenate,
    training_clip_names,
)

ETH_UCY_SCENES = {
    "eth": ("biwi_eth_6frame",),
    "hotel": ("biwi_hotel",),
    "univ": ("students001", "students003"),
    "zara1": ("crowds_zara01",),
    "zara2": ("crowds_zara02",),
}
NEVER_TESTED = ("crowds_zara03", "uni_examples")
# First video frame of each file's validation part, read off the published *_val.txt files.
FIRST_VALIDATION_FRAME = {
    "biwi_eth": 10240,
    "biwi_eth_6frame": 10240,
    "biwi_hotel": 14400,
    "students001": 3550,
    "students003": 4320,
    "crowds_zara01": 7110,
    "crowds_zara02": 8420,
    "crowds_zara03": 6030,
    "uni_examples": 5940,
}
ETH_UCY_SPEC = WindowSpec(observed_steps=8, predicted_steps=12, dt_s=0.4, stride_s=0.4, known_steps=8)
VCI_SPEC = WindowSpec(8, 12, 2 * 1001 / 24000, stride_s=2 * 1001 / 24000)  # 12 Hz, every second video frame
LONG_DUT_SPEC = WindowSpec(8, 12, 0.4, stride_s=0.2)  # 2.5 Hz, 4.8 s ahead
VCI_SHARES = (0.6, 0.2, 0.2)


@dataclass(frozen=True, eq=False)
class Split:
    """Windows by the name of the file or clip they come from."""

    training: dict[str, Windows]
    validation: dict[str, Windows]
    test: Windows


def between(clip: Clip, first: float, last: float) -> Clip:
    """Returns the part of a clip with first <= frame < last."""
    people = []
    for person in clip.pedestrians:
        inside = (person.frames >= first) & (person.frames < last)
        if inside.any():
            part = (person.frames[inside], person.positions_m[inside], person.velocities_mps[inside])
            people.append(replace(person, frames=part[0], positions_m=part[1], velocities_mps=part[2]))
    vehicles = []
    for vehicle in clip.vehicles:
        inside = (vehicle.frames >= first) & (vehicle.frames < last)
        if inside.any():
            vehicles.append(
                replace(
                    vehicle,
                    frames=vehicle.frames[inside],
                    positions_m=vehicle.positions_m[inside],
                    yaw_rad=vehicle.yaw_rad[inside],
                    speed_mps=vehicle.speed_mps[inside],
                )
            )
    return replace(clip, pedestrians=tuple(people), vehicles=tuple(vehicles))


def first_validation_step(file: str) -> int:
    """Returns the first annotation step of a file's validation part, as `load_clip` counts them."""
    return FIRST_VALIDATION_FRAME[file] // frames_per_step(file)


def eth_ucy_fold(
    left_out: str | tuple[str, ...],
    spec: WindowSpec = ETH_UCY_SPEC,
    data_dir: Path | None = None,
    *,
    ten_frame_eth: bool = False,
) -> Split:
    """Returns the windows of the fold that leaves a scene out, or several, or none: `test` holds all of theirs.

    With `ten_frame_eth` ETH-Univ is tested on the 10-frame file that most papers use; training keeps the other.
    """
    out = (left_out,) if isinstance(left_out, str) else left_out
    if unknown := sorted(set(out) - set(ETH_UCY_SCENES)):
        raise ValueError(f"no scenes {unknown}; there are {sorted(ETH_UCY_SCENES)}")
    training, validation = {}, {}
    for scene, files in (*ETH_UCY_SCENES.items(), ("", NEVER_TESTED)):
        for file in files:
            if scene not in out:
                clip = load_clip(f"eth_ucy/{file}", data_dir)
                cut = first_validation_step(file)
                training[file] = clip_windows(between(clip, 0, cut), spec)
                validation[file] = clip_windows(between(clip, cut, np.inf), spec)
    tested = [file for scene in out for file in ETH_UCY_SCENES[scene]]
    if ten_frame_eth:
        tested = ["biwi_eth" if file == "biwi_eth_6frame" else file for file in tested]
    test = [clip_windows(load_clip(f"eth_ucy/{file}", data_dir), spec) for file in tested]
    nothing = clip_windows(Clip("none", RATES_HZ["eth_ucy"], (), ()), spec)
    return Split(training, validation, concatenate([*test, nothing]))


def vci_split(spec: WindowSpec = VCI_SPEC, data_dir: Path | None = None, *, one_vehicle_clips: bool = False) -> Split:
    """Returns the windows of DUT, clip by clip in one of three sets.

    The paper draws 60/20/20 and does not say how. Here the clips, those with most trajectories first, each go to the
    set that lacks most of its share; so no two sets share a moment, or a place and time of day.

    The paper leaves out sequences with more than one vehicle. Here that is read as windows in which more than one is
    seen; with `one_vehicle_clips`, as clips in which there is more than one.
    """
    spec = replace(spec, most_vehicles=1)
    windows = {}
    for name in clip_names("dut", data_dir):
        clip = load_clip(name, data_dir)
        if one_vehicle_clips and len(clip.vehicles) != 1:
            continue
        cut = clip_windows(clip, spec)
        if len(cut):
            windows[name] = cut
    counts = {name: int((w.complete & w.known.all(axis=1)).sum()) for name, w in windows.items()}
    lacking = np.array(VCI_SHARES) * sum(counts.values())
    parts: tuple[dict[str, Windows], ...] = ({}, {}, {})
    for name in sorted(counts, key=lambda name: (-counts[name], name)):
        chosen = int(np.argmax(lacking))
        parts[chosen][name] = windows[name]
        lacking[chosen] -= counts[name]
    return Split(parts[0], parts[1], concatenate([parts[2][name] for name in sorted(parts[2])]))


def long_dut_split(spec: WindowSpec = LONG_DUT_SPEC, data_dir: Path | None = None) -> Split:
    """Returns the long task: DUT at 2.5 Hz, 4.8 s ahead, however many vehicles there are; tested on held-out clips."""

    def windows(names: tuple[str, ...]) -> dict[str, Windows]:
        return {name: clip_windows(load_clip(name, data_dir), spec) for name in names}

    test = windows(HELD_OUT_CLIPS)
    return Split(windows(training_clip_names(data_dir)), windows(VALIDATION_CLIPS), concatenate(list(test.values())))
