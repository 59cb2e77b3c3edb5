"""A tracker's windows survive the file, and a file that does not fit is refused by name."""

import numpy as np
import pytest

from pcgan.dataset import WindowSpec
from pcgan.windows_file import WindowsError, load_windows, save_windows

SPEC = WindowSpec(8, 12, 0.1)


@pytest.fixture
def arrays():
    """Three scenes far from the origin: two people in a training clip, one in a validation clip, one without future."""
    rng = np.random.default_rng(0)
    walk = np.array([50_000.0, -20_000.0]) + rng.normal(size=(4, 1, 2)) + 0.1 * np.arange(20)[:, None]
    future = walk[:, 8:].copy()
    future[1, 7:] = np.nan
    future[3] = np.nan
    seen = np.ones((4, 8), bool)
    seen[0, :3] = False
    vehicle = np.full((3, 8, 4), np.nan)
    vehicle[0] = [50_003.0, -20_000.0, 1.0, 0.0]
    return {
        "observed": walk[:, :8],
        "seen": seen,
        "velocity": np.ones((4, 2)),
        "future": future,
        "scene": np.array([0, 0, 1, 2]),
        "vehicle": vehicle,
        "clips": ["dut/roundabout_01", "dut/roundabout_02", "dut/intersection_01"],
        "dt_s": 0.1,
    }


def test_windows_are_split_by_clip_and_centred_before_rounding(tmp_path, arrays):
    save_windows(tmp_path / "w.npz", **arrays)
    training, validation = load_windows(tmp_path / "w.npz", SPEC)
    assert len(training) == 2  # the scene without any known future is dropped
    assert len(validation) == 1
    walk = np.concatenate([training.observed, training.future], axis=1)
    np.testing.assert_allclose(np.diff(walk, axis=1)[np.isfinite(walk[:, 1:])], 0.1, atol=1e-6)
    np.testing.assert_allclose(training.observed[:, -1].mean(axis=0), 0, atol=1e-6)
    offset = arrays["vehicle"][0, -1, :2] - arrays["observed"][:2, -1].mean(axis=0)
    np.testing.assert_allclose(training.vehicle[:, -1, :2], [offset, offset], atol=1e-5)
    assert np.isnan(validation.vehicle).all()
    assert not training.annotated.any()
    assert training.dt_s == 0.1


def test_who_was_seen_when_and_what_is_known_survives(tmp_path, arrays):
    save_windows(tmp_path / "w.npz", **arrays)
    training, validation = load_windows(tmp_path / "w.npz", SPEC)
    np.testing.assert_array_equal(training.seen, arrays["seen"][:2])
    np.testing.assert_array_equal(validation.seen, arrays["seen"][2:3])
    assert training.known.sum(axis=1).tolist() == [12, 7]  # a future that ends early is kept as far as it goes
    np.testing.assert_array_equal(training.velocity, arrays["velocity"][:2])


def test_neighbours_without_a_future_are_kept(tmp_path, arrays):
    arrays["future"][1] = np.nan
    save_windows(tmp_path / "w.npz", **arrays)
    training, _ = load_windows(tmp_path / "w.npz", SPEC)
    assert training.known.any(axis=1).tolist() == [True, False]


def test_scene_is_kept_for_a_single_known_step(tmp_path, arrays):
    arrays["future"][2, 1:] = np.nan
    save_windows(tmp_path / "w.npz", **arrays)
    _, validation = load_windows(tmp_path / "w.npz", SPEC)
    assert validation.known.tolist() == [[True] + [False] * 11]


def test_file_of_another_format_is_refused(tmp_path, arrays):
    path = tmp_path / "w.npz"
    save_windows(path, **arrays)
    with np.load(path) as file:
        found = dict(file)
    np.savez(path, **(found | {"format": np.array(1)}))
    with pytest.raises(WindowsError, match=r"w\.npz is of windows format 1; this version reads 2"):
        load_windows(path, SPEC)
    np.savez(path, **{name: array for name, array in found.items() if name != "seen"})
    with pytest.raises(WindowsError, match=r"lacks the arrays \['seen'\]"):
        load_windows(path, SPEC)


def test_model_of_other_times_is_refused(tmp_path, arrays):
    save_windows(tmp_path / "w.npz", **arrays)
    with pytest.raises(WindowsError, match=r"w.npz has .*0\.1\); the model needs \(8, 12, 0\.4\)"):
        load_windows(tmp_path / "w.npz", WindowSpec(8, 12, 0.4))


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("velocity", np.ones((4, 3)), r"velocity must have shape \(4, 2\), got \(4, 3\)"),
        ("seen", np.ones((4, 7), bool), r"seen must have shape \(4, 8\), got \(4, 7\)"),
        ("future", np.ones((4, 24)), r"must have shape \(N, steps, 2\)"),
        ("vehicle", np.ones((3, 7, 4)), "vehicle must have shape"),
        ("observed", np.full((4, 8, 2), np.nan), "observed holds NaN"),
        ("scene", np.array([0, 2, 1, 2]), "scene must rise"),
        ("scene", np.array([0, 0, 1, 3]), "within 0 to 2"),
    ],
)
def test_arrays_that_disagree_are_refused(tmp_path, arrays, name, value, problem):
    with pytest.raises(WindowsError, match=problem):
        save_windows(tmp_path / "w.npz", **(arrays | {name: value}))


def test_held_out_clip_is_refused(tmp_path, arrays):
    arrays["clips"][0] = "dut/roundabout_04"
    with pytest.raises(ValueError, match="held-out"):
        save_windows(tmp_path / "w.npz", **arrays)
    assert not (tmp_path / "w.npz").exists()


def test_unreadable_and_pickled_files_are_refused(tmp_path):
    path = tmp_path / "w.npz"
    path.write_bytes(b"not a zip")
    with pytest.raises(WindowsError, match="not a readable"):
        load_windows(path, SPEC)
    np.savez(path, observed=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(WindowsError, match="not a readable"):
        load_windows(path, SPEC)
    np.savez(path, observed=np.zeros((1, 8, 2)))
    with pytest.raises(WindowsError, match="lacks the arrays"):
        load_windows(path, SPEC)
