"""The generator and MultiPAC for one scene in plain numpy: what the predictor runs. `model.py` is the source to read.

Why a second version: a scene is so small that torch spends its time on starting some 1,000 operations of 2 us each.
Here are the equations of `model.py` and `modal_paths.py` in less than half the time: a numpy call costs less, linear
layers that follow one another are multiplied out once, a bias is one more column of its matrix, and an LSTM step is one
product. Tests hold both versions together to 1e-5; training and evaluation use torch alone.

Letters as in `model.py`; pedestrians come last, so that every operation runs over long rows. Everything is float32.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pcgan.mixture_density import LOG_SIGMA_RANGE, MAX_RHO, RAW_PER_COMPONENT
from pcgan.modal_paths import MIN_WEIGHT_SHARE
from pcgan.model import FAR_M, SLOW_MPS, Generator
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
        D, E = self.config.hidden, self.config.embedding
        self._best = generator.best
        # Columns: hidden state, velocity features, the embedding's bias, the LSTM's own bias.
        encoder, decoder = _lstm_matrix(weights, "encoder", "phi_e"), _lstm_matrix(weights, "decoder", "phi_d")
        encoder[:, -1] += encoder[:, -2]  # the decoder's inputs end after its first step, the encoder's never do
        self._encoder, self._decoder = _float32(np.delete(encoder, -2, axis=1)), _float32(decoder)
        inputs = decoder.shape[1] - D - 1
        self._head = _float32(np.insert(_with_bias(weights, "phi_mdn"), [D] * inputs, 0, axis=1))  # reads no inputs

        self._pair = _float32(_with_bias(weights, "gvat.phi_r_pair"))  # (E, 5 or 2, and 1)
        self._score_pair = _float32(weights["gvat.phi_u_pair.weight"])  # (1, E)
        self._score_bias = np.float32(weights["gvat.phi_u_pair.bias"].item())
        self._score_neighbour = _float32(weights["gvat.phi_u_neighbour.weight"])  # (1, D)
        self._score_self = _float32(weights["gvat.phi_u_self.weight"])
        self._pair_vehicle = self._vehicle = None
        if self.config.uses_vehicle:
            self._pair_vehicle = _float32(weights["gvat.phi_r_vehicle.weight"])  # (E, 6 or 2)
        if self.config.uses_vehicle and self._best:
            self._vehicle = _float32(_with_bias(weights, "gvat.phi_vehicle"))  # (E, 6 and 1)

        mlp = _with_bias(weights, "mlp_dec.0")  # columns: hidden, pooled hidden, [pooled pairs, [vehicle]], 1
        mlp[:, D : 2 * D] = mlp[:, D : 2 * D] @ weights["gvat.phi_gat.weight"]
        if self._best:
            mlp[:, 2 * D : 2 * D + E] = mlp[:, 2 * D : 2 * D + E] @ weights["gvat.phi_value.weight"]
        self._mlp, self._mlp_out = _float32(mlp), _float32(_with_bias(weights, "mlp_dec.2"))

    def heading(self, velocity: FloatArray) -> FloatArray:
        """(2, A) m/s -> (2, A) unit vectors: the x axes of the pedestrians' frames; (1, 0) for `paper` and at rest."""
        speed = _norm(velocity)
        moving = speed > SLOW_MPS if self._best else np.zeros(len(speed), bool)
        ahead = np.array([[1], [0]], np.float32)
        return np.where(moving, velocity / np.maximum(speed, SLOW_MPS), ahead)

    def local_mixture(
        self, observed: FloatArray, velocity: FloatArray, vehicle: FloatArray | None, heading: FloatArray
    ) -> LocalMixture:
        """Returns the mixtures of one scene of A > 0 pedestrians, as `Generator.local_mixture` does.

        Args:
            observed: (2, T, A) positions in m, oldest first, any origin near the scene; float32, as the rest.
            velocity: (2, A) present velocity in m/s.
            vehicle: (T, 4) x, y, vx, vy; None if there is none.
            heading: (2, A) `heading(velocity)`.
        """
        config = self.config
        D, A = config.hidden, velocity.shape[1]
        steps = _turned(observed[:, 1:] - observed[:, :-1], heading) / config.dt_s  # (2, T-1, A)
        features = 3 if self._best else 2
        encoder = np.empty((config.observed_steps, D + features + 1, A), np.float32)  # one more for the last hidden
        encoder[0, :D] = 0
        encoder[:-1, D : D + 2] = steps.swapaxes(0, 1)
        encoder[:, -1] = 1
        speed = _norm(velocity)  # (A,)
        if self._best:
            encoder[:, D + 2] = speed
        for block in _blocks(A, self._encoder.size):
            _run_lstm(self._encoder, encoder[..., block])

        pooled = self._pooled(encoder[-1, :D], observed[:, -1], velocity, vehicle, heading)  # (D + pooled + 1, A)
        K, P = config.components, config.predicted_steps
        raw = np.empty((RAW_PER_COMPONENT, K, P, A), np.float32)
        for block in _blocks(A, max(self._decoder.size, self._mlp.size)):
            raw[..., block] = self._decode(pooled[:, block], encoder[-2, D:, block])
        return self._mixture(raw, speed)

    def _decode(self, pooled: FloatArray, last: FloatArray) -> FloatArray:
        """(D + pooled + 1, B), (2 or 3 and 1, B) the last step's features and 1 -> raw mixtures (6, K, P, B)."""
        config = self.config
        D, P, B = config.hidden, config.predicted_steps, pooled.shape[1]
        hidden = np.maximum(self._mlp @ pooled, 0)
        hidden = np.concatenate([hidden, np.ones((1, B), np.float32)])
        decoder = np.zeros((P + 1, self._decoder.shape[1], B), np.float32)  # zero-feed, but for the first
        np.maximum(self._mlp_out @ hidden, 0, out=decoder[0, :D])
        decoder[0, D:-1] = last
        decoder[:, -1] = 1
        _run_lstm(self._decoder, decoder)
        raw = self._head @ decoder[1:]  # (P, 6 K, B)
        return raw.reshape(P, RAW_PER_COMPONENT, -1, B).transpose(1, 2, 0, 3)

    def _mixture(self, raw: FloatArray, speed: FloatArray) -> LocalMixture:
        """(6, K, P, A), (A,) -> the mixtures; consumes `raw`."""
        config = self.config
        weights = _softmax(raw[0], axis=0)
        means = raw[1:3]
        if self._best:  # velocities on top of the present one, summed up over the steps
            for step in range(1, config.predicted_steps):
                means[:, :, step] += means[:, :, step - 1]
            means *= config.dt_s
            times_s = np.arange(1, config.predicted_steps + 1, dtype=np.float32) * config.dt_s
            means[0] += times_s[:, None] * speed
        sigmas = np.exp(raw[3:5].clip(*LOG_SIGMA_RANGE))
        return LocalMixture(weights, means, sigmas, MAX_RHO * np.tanh(raw[5]))

    def _pooled(
        self,
        hidden: FloatArray,
        present: FloatArray,
        velocity: FloatArray,
        vehicle: FloatArray | None,
        heading: FloatArray,
    ) -> FloatArray:
        """GVAT before its last linear layers: rows of the hidden state, pooled (D, E), the vehicle (E), and 1."""
        D, E, A = len(hidden), self.config.embedding, len(hidden[0])
        pooled = np.zeros((self._mlp.shape[1], A), np.float32)
        pooled[:D], pooled[-1] = hidden, 1
        row_term = None  # (E, A) the vehicle's share in r, the same for all j
        if vehicle is not None and self._pair_vehicle is not None:
            seen = self._vehicle_features(present, velocity, vehicle, heading)  # (6 or 2, A)
            row_term = self._pair_vehicle @ seen
            if self._vehicle is not None:
                with_one = np.concatenate([seen, np.ones((1, A), np.float32)])
                np.maximum(self._vehicle @ with_one, 0, out=pooled[2 * D + E : 2 * D + 2 * E])
        neighbour_score = self._score_neighbour @ hidden  # (1, A)
        self_score = (self._score_self @ hidden + self._score_bias).T  # (A, 1)
        states = np.stack([present, velocity], axis=1)  # (2 components, 2, A)
        for rows in _blocks(A, A * D):
            pairs = self._pair_features(states, heading[:, rows], rows)  # (5 or 2 and 1, B, A)
            B = pairs.shape[1]
            r = np.empty((E, B, A), np.float32)
            for cut in _blocks(B * A, self._pair.size):
                np.matmul(self._pair, pairs.reshape(-1, B * A)[:, cut], out=r.reshape(E, -1)[:, cut])
            if row_term is not None:
                r += row_term[:, rows, None]
            if self._best:
                np.maximum(r, 0, out=r)
            u = (self._score_pair @ r.reshape(E, -1)).reshape(B, A)
            u += neighbour_score
            u += self_score[rows]
            if self._best:
                np.maximum(u, 0.2 * u, out=u)
            own = (np.arange(B), np.arange(A)[rows])  # nobody is their own neighbour
            u[own] = -1e9
            attention = _softmax(u, axis=1)
            attention[own] = 0  # also where there is nobody else
            pooled[D : 2 * D, rows] = hidden @ attention.T
            if self._best:
                pooled[2 * D : 2 * D + E, rows] = np.einsum("eij,ij->ei", r, attention)
        return pooled

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


def to_scene(mixture: LocalMixture, heading: FloatArray) -> LocalMixture:
    """Returns the mixtures turned out of their heading frames, as `mixture_density.rotate` does."""
    (c, s), (sigma_x, sigma_y) = heading, mixture.sigmas_m
    var_x, var_y, cov = np.square(sigma_x), np.square(sigma_y), mixture.rhos * sigma_x * sigma_y
    cc, ss, cs = c * c, s * s, c * s
    twice = 2 * cs * cov
    sigmas = np.sqrt(np.stack([cc * var_x + ss * var_y - twice, ss * var_x + cc * var_y + twice]))
    rhos = (cs * (var_x - var_y) + (cc - ss) * cov) / (sigmas[0] * sigmas[1])
    return LocalMixture(mixture.weights, points_to_scene(mixture.means_m, heading), sigmas, rhos.clip(-0.9999, 0.9999))


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
