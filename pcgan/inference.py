"""The generator and MultiPAC for one scene in plain numpy: what the predictor runs. `model.py` is the source to read.

Why a second version: a scene is so small that torch spends its time on starting some 1,000 operations of 2 us each.
Here are the equations of `model.py` and `modal_paths.py` in less than half the time: a numpy call costs less, linear
layers that follow one another are multiplied out once, a bias is one more column of its matrix, and an LSTM step is one
product. Tests hold both versions together to 1e-5; training and evaluation use torch alone.

Letters as in `model.py`; pedestrians come last, so that every operation runs over long rows. Everything is float32.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pcgan.mixture_density import LOG_SIGMA_RANGE, MAX_RHO, RAW_PER_COMPONENT
from pcgan.modal_paths import MIN_WEIGHT_SHARE
from pcgan.model import FAR_M, GVAT, MIN_WIGGLE_M, SLOW_MPS, WIGGLE_FEATURES, Generator
from schemas.messages import BoolArray, FloatArray, IntArray

# OpenBLAS keeps a product of up to 2^18 multiplications on the calling thread. Larger ones are cut up below: no thread
# has to be woken, and the answer's last bits do not depend on how many cores a machine has.
_MAX_PRODUCT = 1 << 18


@dataclass(frozen=True, eq=False)
class LocalMixture:
    """Mixtures in each pedestrian's own frame: relative to its last position, x along its heading."""

    weights: FloatArray  # (K, P, A)
    means_m: FloatArray  # (2, K, P, A)
    sigmas_m: FloatArray  # (2, K, P, A)
    rhos: FloatArray  # (K, P, A)


class NumpyGenerator:
    """A generator's weights, multiplied out for inference; gives `Generator.local_mixture` of one scene."""

    def __init__(self, generator: Generator):
        weights = {name: value.detach().double().numpy() for name, value in generator.state_dict().items()}
        self.config = generator.config
        D = self.config.hidden
        self._best = generator.best
        # Columns: hidden state, velocity features, the embedding's bias, the LSTM's own bias.
        encoder, decoder = _lstm_matrix(weights, "encoder", "phi_e"), _lstm_matrix(weights, "decoder", "phi_d")
        encoder[:, -1] += encoder[:, -2]  # the decoder's inputs end after its first step, the encoder's never do
        self._encoder, self._decoder = _float32(np.delete(encoder, -2, axis=1)), _float32(decoder)
        inputs = decoder.shape[1] - D - 1
        self._head = _float32(np.insert(_with_bias(weights, "phi_mdn"), [D] * inputs, 0, axis=1))  # reads no inputs
        self._widening = _float32(np.exp(weights["log_sigma_shift"]))[:, None]  # (P, 1)
        self._pooling = _pooling(generator, weights)
        self._vehicle = _mlp(weights, "vehicle_layers") if generator.vehicle_layers is not None else None
        self._velocity = _mlp(weights, "velocity_weights") if self._best else None
        self._mlp = _mlp(weights, "mlp_dec")  # reads the hidden state, wiggle, pooled, vehicle, and 1

    def heading(self, velocity: FloatArray) -> FloatArray:
        """(2, A) m/s -> (2, A) unit vectors: the x axes of the pedestrians' frames; (1, 0) for `paper` and at rest."""
        speed = _norm(velocity)
        moving = speed > SLOW_MPS if self._best else np.zeros(len(speed), bool)
        ahead = np.array([[1], [0]], np.float32)
        return np.where(moving, velocity / np.maximum(speed, SLOW_MPS), ahead)

    def local_mixture(
        self,
        observed: FloatArray,
        seen: BoolArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> LocalMixture:
        """Returns the mixtures of one scene of A > 0 pedestrians, as `Generator.local_mixture` does.

        Args:
            observed: (2, T, A) positions in m, oldest first, any origin near the scene; float32, as the rest.
            seen: (T, A) bool, at which steps; the positions of others only fill in.
            velocity: (2, A) present velocity in m/s.
            vehicle: (T, 4) x, y, vx, vy; None if there is none.
            heading: (2, A) `heading(velocity)`.
        """
        config = self.config
        D, A = config.hidden, velocity.shape[1]
        moved = observed[:, 1:] - observed[:, :-1]  # (2, T-1, A) m
        steps = _turned(moved, heading) / config.dt_s
        speed = _norm(velocity)  # (A,)
        begun = np.logical_or.accumulate(seen, axis=0)[:-1].astype(np.float32)  # (T-1, A)
        features = 5 if self._best else 2
        encoder = np.empty((config.observed_steps, D + features + 1, A), np.float32)  # one more for the last hidden
        encoder[0, :D] = 0
        encoder[:-1, D : D + 2] = steps.swapaxes(0, 1)
        encoder[:, -1] = 1
        if self._best:
            encoder[:-1, D + 2] = speed
            encoder[:-1, D + 3] = begun
            encoder[:-1, D + 4] = seen[1:]
        for block in _blocks(A, self._encoder.size):
            _run_lstm(self._encoder, encoder[..., block])

        hidden = encoder[-1, :D]
        parts = [hidden]
        if self._best:
            parts.append(_wiggle(moved, begun))
        state = np.concatenate([*parts, np.ones((1, A), np.float32)])  # (D + wiggle + 1, A)
        found = None
        if vehicle is not None and config.uses_vehicle:
            found = self._vehicle_features(observed[:, -1], velocity, vehicle, heading)  # (6 or 2, A)
        if self._pooling is not None:
            parts.append(self._pooling.pooled(np.ascontiguousarray(hidden), observed[:, -1], velocity, found, heading))
        if self._vehicle is not None:
            parts.append(self._seen_vehicle(hidden, found))
        pooled = np.concatenate([*parts, np.ones((1, A), np.float32)])
        K, P = config.components, config.predicted_steps
        raw = np.empty((RAW_PER_COMPONENT, K, P, A), np.float32)
        for block in _blocks(A, max(self._decoder.size, self._mlp[0].size)):
            raw[..., block] = self._decode(pooled[:, block], encoder[-2, D:, block])
        base = self._base_velocity(state, steps, begun, speed) if self._best else None
        return self._mixture(raw, base)

    def _seen_vehicle(self, hidden: FloatArray, found: FloatArray | None) -> FloatArray:
        """(D, A), (6, A) or None -> (E, A): what the vehicle means to each pedestrian; zeros without one."""
        assert self._vehicle is not None
        if found is None:
            return np.zeros((len(self._vehicle[1]), hidden.shape[1]), np.float32)
        inputs = np.concatenate([hidden, found, np.ones((1, hidden.shape[1]), np.float32)])
        return np.maximum(_perceived(self._vehicle, inputs), 0)

    def _base_velocity(self, state: FloatArray, steps: FloatArray, begun: FloatArray, speed: FloatArray) -> FloatArray:
        """(D + wiggle + 1, A), (2, T-1, A), (T-1, A), (A,) -> (2, A) m/s in the heading frame."""
        assert self._velocity is not None
        weights = _perceived(self._velocity, state).reshape(len(begun), 2, -1)  # (T-1, 2, A)
        base: FloatArray = np.einsum("tca,cta,ta->ca", weights, steps, begun)
        base[0] += speed
        return base

    def _decode(self, pooled: FloatArray, last: FloatArray) -> FloatArray:
        """(some + 1, B), (2 or 5 and 1, B) the last step's features and 1 -> raw mixtures (6, K, P, B)."""
        config = self.config
        D, P, B = config.hidden, config.predicted_steps, pooled.shape[1]
        decoder = np.zeros((P + 1, self._decoder.shape[1], B), np.float32)  # zero-feed, but for the first
        np.maximum(_perceived(self._mlp, pooled), 0, out=decoder[0, :D])
        decoder[0, D:-1] = last
        decoder[:, -1] = 1
        _run_lstm(self._decoder, decoder)
        raw = self._head @ decoder[1:]  # (P, 6 K, B)
        return raw.reshape(P, RAW_PER_COMPONENT, -1, B).transpose(1, 2, 0, 3)

    def _mixture(self, raw: FloatArray, base: FloatArray | None) -> LocalMixture:
        """(6, K, P, A), (2, A) or None for `paper` -> the mixtures; consumes `raw`."""
        weights = _softmax(raw[0], axis=0)
        means = raw[1:3]
        if base is not None:  # velocities on top of the base's, summed up over the steps
            means += base[:, None, None]
            for step in range(1, self.config.predicted_steps):
                means[:, :, step] += means[:, :, step - 1]
            means *= self.config.dt_s
        sigmas = np.exp(raw[3:5].clip(*LOG_SIGMA_RANGE)) * self._widening
        return LocalMixture(weights, means, sigmas, MAX_RHO * np.tanh(raw[5]))

    def _vehicle_features(
        self, present: FloatArray, velocity: FloatArray, vehicle: FloatArray, heading: FloatArray
    ) -> FloatArray:
        """(2, A), (2, A), (T, 4), (2, A) -> (6, A), or (2, A) for `paper`: the vehicle as each pedestrian sees it."""
        offset = vehicle[-1, :2, None] - present
        if not self._best:
            return -offset
        features = np.empty((2, 3, offset.shape[1]), np.float32)  # (2 components, 3, A)
        features[:, 0] = offset / (_norm(offset) + FAR_M)
        features[:, 1] = (vehicle[-1, 2:, None] - velocity) * 0.2
        features[:, 2] = (vehicle[-1, 2:] - vehicle[0, 2:])[:, None]
        return _turned(features, heading).swapaxes(0, 1).reshape(6, -1)


class _Pooling(Protocol):
    def pooled(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> FloatArray:
        """(D, A), (2, A), (2, A), (6 or 2, A) or None, (2, A) -> (some, A)."""
        ...


class _PaperGVAT:
    """`model.PaperGVAT`."""

    def __init__(self, weights: dict[str, FloatArray]):
        # The terms that do not depend on the neighbour cancel in the softmax: they need not be added.
        score = weights["gvat.phi_u_pair.weight"] @ weights["gvat.phi_r_pair.weight"]  # (1, 2), by x_i - x_j
        self._place = _float32(-score)
        self._neighbour = _float32(weights["gvat.phi_u_neighbour.weight"])  # (1, D)
        self._gat = _float32(weights["gvat.phi_gat.weight"])

    def pooled(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,  # noqa: ARG002
        vehicle: FloatArray | None,  # noqa: ARG002  it cannot matter
        heading: FloatArray,  # noqa: ARG002
    ) -> FloatArray:
        """Returns (D, A)."""
        A = hidden.shape[1]
        pooled = np.empty_like(hidden)
        score = self._neighbour @ hidden + self._place @ present  # (1, A)
        for rows in _blocks(A, A * len(hidden)):
            u = np.repeat(score, rows.stop - rows.start, axis=0)  # (B, A)
            attention = _attention(u, rows)
            pooled[:, rows] = hidden @ attention.T
        out: FloatArray = self._gat @ pooled
        return out


class _Messages:
    """What `model.GVAT` and `model.SocialPooling` share: a message from every neighbour, by two layers."""

    def __init__(self, weights: dict[str, FloatArray], name: str, out: str, *, best: bool):
        self._best = best
        self._pair = _float32(_with_bias(weights, f"{name}.phi_pair"))  # (M, 5 or 2, and 1)
        self._neighbour = _float32(weights[f"{name}.phi_neighbour.weight"])  # (M, D)
        self._own: FloatArray | None = None
        if f"{name}.phi_self.weight" in weights:
            self._own = _float32(weights[f"{name}.phi_self.weight"])
        self._vehicle: FloatArray | None = None
        if f"{name}.phi_vehicle.weight" in weights:
            self._vehicle = _float32(weights[f"{name}.phi_vehicle.weight"])
        self._out = _float32(weights[f"{name}.{out}.weight"])  # (D, M)
        self._out_bias = _float32(weights[f"{name}.{out}.bias"])[:, None, None]

    def messages(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> Iterator[tuple[slice, FloatArray]]:
        """Yields pedestrians i, and the messages (D, B, A) of all j to them."""
        A, M = hidden.shape[1], len(self._pair)
        neighbour = self._neighbour @ hidden  # (M, A)
        own = self._own @ hidden if self._own is not None else None
        if own is not None and vehicle is not None and self._vehicle is not None:
            own += self._vehicle @ vehicle
        states = np.stack([present, velocity], axis=1)  # (2 components, 2, A)
        for rows in _blocks(A, A * M):
            pairs = self._pair_features(states, heading[:, rows], rows)  # (5 or 2 and 1, B, A)
            B = pairs.shape[1]
            first = np.empty((M, B, A), np.float32)
            _multiply(self._pair, pairs.reshape(-1, B * A), first.reshape(M, -1))
            first += neighbour[:, None] if own is None else neighbour[:, None] + own[:, rows, None]
            np.maximum(first, 0, out=first)
            message = np.empty((len(self._out), B, A), np.float32)
            _multiply(self._out, first.reshape(M, -1), message.reshape(len(message), -1))
            message += self._out_bias
            yield rows, np.maximum(message, 0, out=message)

    def _pair_features(self, states: FloatArray, heading: FloatArray, rows: slice) -> FloatArray:
        """(2, 2, A) positions and velocities, (2, B) -> (6 or 3, B, A): j relative to i in `rows`, and 1."""
        if not self._best:
            pairs = np.ones((3, heading.shape[1], states.shape[2]), np.float32)
            np.subtract(states[:, 0, rows, None], states[:, 0, None], out=pairs[:2])
            return pairs
        relative = states[:, :, None] - states[:, :, rows, None]  # (2 components, 2, B, A)
        distance = _norm(relative[:, 0])  # (B, A)
        relative[:, 0] /= distance + FAR_M
        pairs = np.ones((6, *distance.shape), np.float32)
        pairs[:4].reshape(relative.shape)[:] = _turned(relative, heading[..., None]).swapaxes(0, 1)
        np.divide(1, distance + 1, out=pairs[4])
        return pairs


class _GVAT(_Messages):
    """`model.GVAT`."""

    def __init__(self, weights: dict[str, FloatArray]):
        super().__init__(weights, "gvat", "phi_message", best=True)
        self._score = _float32(weights["gvat.phi_u.weight"])  # (heads, D)
        self._score_bias = _float32(weights["gvat.phi_u.bias"])[:, None, None]

    def pooled(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> FloatArray:
        """Returns (2 D, A): what was attended to, and the maximum."""
        D, A = hidden.shape
        pooled = np.empty((2 * D, A), np.float32)
        for rows, message in self.messages(hidden, present, velocity, vehicle, heading):
            u = np.empty((GVAT.HEADS, *message.shape[1:]), np.float32)
            _multiply(self._score, message.reshape(D, -1), u.reshape(GVAT.HEADS, -1))
            u += self._score_bias
            attention = _attention(np.maximum(u, 0.2 * u), rows)  # (heads, B, A)
            shares = message.reshape(GVAT.HEADS, -1, *message.shape[1:])  # (heads, D / heads, B, A)
            pooled[:D, rows] = np.einsum("hdij,hij->hdi", shares, attention).reshape(D, -1)
            pooled[D:, rows] = _highest(message, rows)
        return pooled


class _SocialPooling(_Messages):
    """`model.SocialPooling`."""

    def __init__(self, weights: dict[str, FloatArray], *, best: bool):
        super().__init__(weights, "social", "phi_out", best=best)

    def pooled(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> FloatArray:
        """Returns (D, A)."""
        pooled = np.empty_like(hidden)
        for rows, message in self.messages(hidden, present, velocity, vehicle, heading):
            pooled[:, rows] = _highest(message, rows)
        return pooled


def _pooling(generator: Generator, weights: dict[str, FloatArray]) -> _Pooling | None:
    if generator.social is not None:
        return _SocialPooling(weights, best=generator.best)
    if generator.gvat is not None:
        return _GVAT(weights) if generator.best else _PaperGVAT(weights)
    return None


def _attention(u: FloatArray, rows: slice) -> FloatArray:
    """(..., B, A) scores of all j for the pedestrians in `rows` -> their softmax over j; nobody attends to himself."""
    own = (..., np.arange(u.shape[-2]), np.arange(u.shape[-1])[rows])
    u[own] = -1e9
    attention = _softmax(u, axis=-1)
    attention[own] = 0  # also where there is nobody else
    return attention


def _highest(message: FloatArray, rows: slice) -> FloatArray:
    """(D, B, A) messages of all j, not below 0 -> (D, B): the maximum over the others; consumes `message`."""
    message[:, np.arange(message.shape[1]), np.arange(message.shape[2])[rows]] = 0
    return np.asarray(message.max(axis=2))


def _wiggle(moved: FloatArray, begun: FloatArray) -> FloatArray:
    """(2, T-1, A) displacements in m, (T-1, A) -> (5, A), as `Generator.wiggle`; everybody shares the scene."""
    bends = (moved[:, 1:] - moved[:, :-1]) * begun[:-1]  # (2, T-2, A)
    sums = np.empty((3, moved.shape[2]), np.float32)
    sums[0] = np.square(bends).sum(axis=(0, 1))
    sums[1] = (bends[:, 1:] * bends[:, :-1]).sum(axis=(0, 1))
    sums[2] = 2 * begun[:-1].sum(axis=0)
    features = np.empty((WIGGLE_FEATURES, moved.shape[2]), np.float32)
    for row, (square, lagged, count) in enumerate((sums, sums.sum(axis=1, keepdims=True))):
        variance = square / np.maximum(count, 1) + MIN_WIGGLE_M**2
        features[2 * row] = 0.5 * np.log(variance) + 3
        features[2 * row + 1] = lagged / (square + MIN_WIGGLE_M**2)
    features[4] = begun.mean(axis=0)
    return features


def to_scene(mixture: LocalMixture, heading: FloatArray) -> LocalMixture:
    """Returns the mixtures turned out of their heading frames, as `mixture_density.rotate` does."""
    (c, s), (sigma_x, sigma_y) = heading, mixture.sigmas_m
    var_x, var_y, cov = np.square(sigma_x), np.square(sigma_y), mixture.rhos * sigma_x * sigma_y
    cc, ss, cs = c * c, s * s, c * s
    twice = 2 * cs * cov
    sigmas = np.sqrt(np.stack([cc * var_x + ss * var_y - twice, ss * var_x + cc * var_y + twice]))
    rhos = (cs * (var_x - var_y) + (cc - ss) * cov) / (sigmas[0] * sigmas[1])
    return LocalMixture(mixture.weights, points_to_scene(mixture.means_m, heading), sigmas, rhos.clip(-0.9999, 0.9999))


def widened(mixture: LocalMixture, covariances: FloatArray) -> LocalMixture:
    """Returns the mixtures with a covariance (A, 2, 2) in m^2 added to every component; itself if all are zero."""
    if not covariances.any():
        return mixture
    sigma_x, sigma_y = mixture.sigmas_m
    more = covariances.astype(np.float32)
    sigmas = np.sqrt(np.stack([np.square(sigma_x) + more[:, 0, 0], np.square(sigma_y) + more[:, 1, 1]]))
    rhos = (mixture.rhos * sigma_x * sigma_y + more[:, 0, 1]) / (sigmas[0] * sigmas[1])
    return LocalMixture(mixture.weights, mixture.means_m, sigmas, rhos.clip(-0.9999, 0.9999))


def points_to_scene(points: FloatArray, heading: FloatArray) -> FloatArray:
    """(2, ..., A) in heading frames, (2, A) -> (2, ..., A) along the scene's axes; still from each last position."""
    return _turned(points, heading * np.array([[1], [-1]], np.float32))


def modal_paths(weights: FloatArray, means: FloatArray, eps_m: float) -> tuple[FloatArray, FloatArray]:
    """Returns the modal paths of weights (K, P, A) and means (2, K, P, A) in m, as `modal_paths.modal_paths` does.

    Returns:
        probabilities (L, A), falling, 0 where there is no path, with L the most paths that one of A > 0 pedestrians
        has; points (2, P, L, A) in m.
    """
    K = len(weights)
    live = weights >= MIN_WEIGHT_SHARE / K
    relative = means[:, :, None] - means[:, None]  # (2, K, K, P, A)
    np.square(relative, out=relative)
    reach: BoolArray = relative[0] + relative[1] <= eps_m * eps_m  # (K, K, P, A)
    reach &= live[:, None]
    reach &= live
    for k in range(K):  # Warshall's closure
        reach |= reach[:, k, None] & reach[k]
    is_root = live.copy()  # a cluster goes by its lowest component
    for k in range(1, K):
        is_root[k] &= ~reach[k, :k].any(axis=0)

    share = (reach & is_root[:, None]) * weights  # (K clusters, K members, P, A)
    mass = share.sum(axis=1)  # (K, P, A) 0 where there is no cluster
    centroids = np.einsum("kmpa,cmpa->ckpa", share, means) / np.where(is_root, mass, np.float32(1))  # (2, K, P, A)

    probabilities = mass[:, -1] / mass[:, -1].sum(axis=0)  # (K, A)
    L = int(is_root[:, -1].sum(axis=0).max())
    order = np.argsort(-probabilities, axis=0, kind="stable")[:L]
    probabilities = probabilities[order, np.arange(order.shape[1])]  # (L, A)
    ends = np.where(probabilities > 0, order, is_root[:, -1].argmax(axis=0))
    return probabilities, _traced_back(centroids, is_root, ends)


def _traced_back(centroids: FloatArray, is_root: BoolArray, ends: IntArray) -> FloatArray:
    """(2, K, P, A), (K, P, A), (L, A) -> (2, P, L, A): from given clusters of the last step, always to the nearest."""
    K, P, A = is_root.shape
    distance2 = np.square(centroids[:, :, None, :-1] - centroids[:, None, :, 1:]).sum(axis=0)  # (K before, K now, ...)
    distance2 += np.where(is_root[:, :-1], np.float32(0), np.float32(1e30))[:, None]
    parent = np.zeros(distance2.shape[1:], np.intp)  # (K, P-1, A)
    least = distance2[0]
    for k in range(1, K):
        np.copyto(parent, k, where=distance2[k] < least)  # ties go to the lowest
        least = np.minimum(least, distance2[k])
    own = np.arange(A)
    links = parent.swapaxes(0, 1).reshape(P - 1, K * A)
    branch = np.empty((P, *ends.shape), np.intp)
    branch[-1] = ends
    for step in range(P - 2, -1, -1):
        branch[step] = links[step].take(branch[step + 1] * A + own)
    index = branch * (P * A) + np.arange(P * A).reshape(P, 1, A)
    points: FloatArray = centroids.reshape(2, -1).take(index, axis=1)
    return points


def _run_lstm(matrix: FloatArray, states: FloatArray) -> None:
    """Fills in an LSTM's hidden states after its first; its first cell state is zero.

    Args:
        matrix: (4 D, D + inputs) by `_lstm_matrix`.
        states: (T + 1, D + inputs, A) hidden states over the inputs of T steps; the last inputs are not read.
    """
    D, A = len(matrix) // 4, states.shape[2]
    gates = np.empty((4 * D, A), np.float32)
    sigmoids = gates[: 3 * D]
    i, f, o, g = gates.reshape(4, D, A)
    cell, new = np.zeros((2, D, A), np.float32)
    for step in range(len(states) - 1):
        np.matmul(matrix, states[step], out=gates)
        np.tanh(gates, out=gates)
        sigmoids *= 0.5  # 1 / (1 + exp(-x)) = tanh(x / 2) / 2 + 1 / 2; the inner half is in the matrix
        sigmoids += 0.5
        cell *= f
        i *= g
        cell += i
        np.tanh(cell, out=new)
        np.multiply(o, new, out=states[step + 1, :D])


def _lstm_matrix(weights: dict[str, FloatArray], lstm: str, embedding: str) -> FloatArray:
    """Returns (4 D, D + X + 2): hidden state, the embedding's X inputs, its bias, the LSTM's own bias -> gates.

    Gates come in the order input, forget, output, cell (torch: input, forget, cell, output), the first three halved.
    """
    w_input = weights[f"{lstm}.weight_ih_l0"]  # (4 D, E)
    bias = weights[f"{lstm}.bias_ih_l0"] + weights[f"{lstm}.bias_hh_l0"]
    parts = [weights[f"{lstm}.weight_hh_l0"], w_input @ _with_bias(weights, embedding), bias[:, None]]
    i, f, g, o = np.split(np.concatenate(parts, axis=1), 4)
    return np.concatenate([i / 2, f / 2, o / 2, g])


def _mlp(weights: dict[str, FloatArray], layers: str) -> tuple[FloatArray, FloatArray]:
    """Returns the matrices of two layers with a ReLU between them, biases as last columns."""
    return _float32(_with_bias(weights, f"{layers}.0")), _float32(_with_bias(weights, f"{layers}.2"))


def _perceived(layers: tuple[FloatArray, FloatArray], inputs: FloatArray) -> FloatArray:
    """(inputs and 1, A) -> (outputs, A) of two layers with a ReLU between them."""
    first, second = layers
    out = np.empty((len(second), inputs.shape[1]), np.float32)
    for block in _blocks(inputs.shape[1], max(first.size, second.size)):
        hidden = np.maximum(first @ inputs[:, block], 0)
        np.matmul(second[:, :-1], hidden, out=out[:, block])
    out += second[:, -1:]
    return out


def _multiply(matrix: FloatArray, columns: FloatArray, out: FloatArray) -> None:
    """(M, X) @ (X, n) -> out (M, n), in products that stay on this thread."""
    for cut in _blocks(columns.shape[1], matrix.size):
        np.matmul(matrix, columns[:, cut], out=out[:, cut])


def _float32(matrix: FloatArray) -> FloatArray:
    return np.ascontiguousarray(matrix, np.float32)


def _with_bias(weights: dict[str, FloatArray], layer: str) -> FloatArray:
    """Returns a linear layer's weight with its bias as one more column."""
    return np.concatenate([weights[f"{layer}.weight"], weights[f"{layer}.bias"][:, None]], axis=1)


def _turned(vectors: FloatArray, heading: FloatArray) -> FloatArray:
    """(2, ..., A) along the scene's axes, (2, ...) -> the same along `heading` and to its left."""
    (c, s), (x, y) = heading, vectors
    out = np.empty(vectors.shape, np.float32)
    np.add(c * x, s * y, out=out[0])
    np.subtract(c * y, s * x, out=out[1])
    return out


def _norm(vectors: FloatArray) -> FloatArray:
    """(2, ...) -> (...)."""
    x, y = vectors
    return np.asarray(np.sqrt(x * x + y * y))


def _softmax(values: FloatArray, axis: int) -> FloatArray:
    out = np.exp(values - values.max(axis=axis, keepdims=True))
    out /= out.sum(axis=axis, keepdims=True)
    return np.asarray(out)


def _blocks(count: int, multiplications_each: int) -> Iterator[slice]:
    """Yields slices of 0..count-1, as long as a product over one of them stays small."""
    size = max(1, _MAX_PRODUCT // multiplications_each)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
