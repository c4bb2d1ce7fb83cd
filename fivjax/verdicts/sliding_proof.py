r"""The proof that sliding is reached: no contact event can happen again.

While the contact slides and the load no longer changes, the deviation $z$ from the sliding equilibrium obeys
$\dot z = A z$ (plus a remainder, for friction that depends on slip speed). Sliding ends when the normal force or the slip
speed reaches zero. Both are affine in $z$, so the proof is a bound on two sums $\sum_k a_k e^{λ_k t}$ over the whole
future. A quiet interval proves nothing: close to the stability limit two modes are almost parallel, and the response to a
kick grows for a second before it decays.

- Constant friction: a bound on the sum that includes the slow beat of the modes (`envelope_peak`).
- Speed-dependent friction: the linear motion with a bound on the remainder (`_margin_share_nonlinear`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ..contact import Contact, Mechanics, State, Status
from ..foundation import complex_pairs
from ..foundation.complex_pairs import Pair
from ..foundation.precision import in_double_precision
from ..linear.linearisation import LOWEST_SLIP, LinearSliding
from ..model.friction_per_contact import FrictionPerContact
from ..model.scene import Scene
from ..model.sliding import sliding_states


class SlidingModes(eqx.Module):
    """`LinearSliding` in modal coordinates w = V⁻¹z; of a conjugate pair only the upper mode is kept, counted twice."""

    linear: LinearSliding
    eigenvalues: Complex[Array | np.ndarray, "*groups k"]  # 1/s
    to_modal: Complex[Array | np.ndarray, "*groups k m"]  # rows of V⁻¹
    from_modal: Complex[Array | np.ndarray, "*groups m k"]  # z is the real part of this times w
    regular: Bool[Array | np.ndarray, "*groups"]  # whether V is far enough from singular to compute z from w
    # Shares of the modes in pressing and slip; with several contacts, in those of each.
    pressing: Complex[Array | np.ndarray, "*groups_contacts k"]
    slip: Complex[Array | np.ndarray, "*groups_contacts k"]
    remainder: Complex[Array | np.ndarray, "*groups_contacts k"]
    envelope: "Envelope"
    slowest_period: Float[Array | np.ndarray, "*groups"]  # of the sliding motion, s
    stable: Bool[Array | np.ndarray, "*groups"]


class Envelope(eqx.Module):
    """Tables of the modes at some instants for `envelope_peak`; clusters are modes that are bounded together."""

    growth: Complex[Array | np.ndarray, "*groups c i k"]  # of each mode, relative to the mean of its cluster
    bending: Float[Array | np.ndarray, "*groups c i k"]  # bounds on the second derivatives of `growth`, 1/s²
    decay: Float[Array | np.ndarray, "*groups c interval"]  # of the cluster
    chord: Float[Array | np.ndarray, "*groups c interval"]  # largest distance from the chord per second derivative, s²
    last: Float[Array | np.ndarray, "*groups c k"]  # sizes of the modes at the last instant
    members: Float[Array | np.ndarray, "*groups c k"]  # one for the modes of a cluster, else zero


def sliding_modes(linear: LinearSliding) -> SlidingModes:
    """Modal coordinates of a batch of sliding motions (leading axis), by NumPy.

    They are needed once per structure and friction, not in each step, and eigenvectors of general matrices are not available on
    every accelerator.
    """
    linear = jax.tree.map(np.asarray, linear)
    finite = np.all(np.isfinite(linear.matrix), axis=(-2, -1))
    matrix = np.where(finite[:, None, None], linear.matrix, -np.eye(linear.matrix.shape[-1]))
    # Real ones where all of them are.
    eigenvalues, vectors = (part.astype(complex) for part in np.linalg.eig(matrix))
    # A defective matrix has no modal coordinates. Infinite entries make every bound infinite, so nothing is proved.
    inverse = np.full(vectors.shape, np.inf, complex)
    condition = np.where(finite, _condition(eigenvalues, vectors), np.inf)
    # States are computed from modal coordinates only where the condition number of the modes is below this.
    well_conditioned = condition < 1e4
    # Without damping, motions go on for ever unless modes have coalesced: real parts are rounding errors.
    half = matrix.shape[-1] // 2
    undamped = np.all(matrix[:, half:, half:] == 0, axis=(1, 2)) & well_conditioned
    undamped &= np.all(np.abs(eigenvalues.real) <= 1e-10 * np.abs(eigenvalues), axis=-1)
    eigenvalues.real[undamped] = 0.0
    regular = condition < 1e9
    inverse[regular] = np.linalg.inv(vectors[regular])
    # Sorted so that the upper half plane comes first; the conjugates are then cut off.
    order = np.argsort(-eigenvalues.imag, axis=-1, kind="stable")
    kept = int(np.max(np.sum(eigenvalues.imag >= 0, axis=-1)))
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)[:, :kept]
    inverse = np.take_along_axis(inverse, order[:, :, None], axis=1)[:, :kept]
    vectors = np.take_along_axis(vectors, order[:, None, :], axis=2)[:, :, :kept]
    count = np.where(eigenvalues.imag > 0, 2.0, np.where(eigenvalues.imag == 0, 1.0, 0.0))
    from_modal = np.einsum("gk,gmk->gmk", count, vectors)
    # By more than the rounding errors of real parts, which are the larger the closer modes are to coalescing.
    rounding = 4 * matrix.shape[-1] * np.finfo(float).eps * np.minimum(condition, 1e9)
    decays = np.max(eigenvalues.real, axis=-1) < -rounding * np.max(np.abs(eigenvalues), axis=-1)
    return SlidingModes(
        linear=linear,
        eigenvalues=eigenvalues,
        to_modal=inverse,
        from_modal=from_modal,
        regular=well_conditioned,
        pressing=_of_modes(linear.pressing, from_modal),
        slip=_of_modes(linear.slip, from_modal),
        remainder=_in_modes(np.where(np.isfinite(inverse), inverse, 0), linear.remainder),
        envelope=envelope(eigenvalues, _clusters(eigenvalues)),
        slowest_period=_slowest_period(eigenvalues),
        stable=regular & (decays | undamped),
    )


def _condition(eigenvalues: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """The condition numbers of modes, whatever the units: with displacements times a typical frequency beside velocities."""
    moving = eigenvalues != 0
    sizes = np.log(np.abs(np.where(moving, eigenvalues, 1.0)))
    typical = np.exp(np.sum(sizes, axis=-1) / np.maximum(np.sum(moving, axis=-1), 1))
    half = vectors.shape[-1] // 2
    scaled = np.concatenate([vectors[:, :half] * typical[:, None, None], vectors[:, half:]], axis=1)
    return np.linalg.cond(scaled / np.linalg.norm(scaled, axis=1, keepdims=True))


def _of_modes(
    rows: Float[np.ndarray, "groups *contacts m"], from_modal: Complex[np.ndarray, "groups m k"]
) -> Complex[np.ndarray, "groups *contacts k"]:
    """The shares of the modes in these functions of the state, given by their derivatives."""
    return np.einsum("g...m,gmk->g...k", rows, from_modal)


def _in_modes(
    to_modal: Complex[np.ndarray, "groups k m"], columns: Float[np.ndarray, "groups *contacts m"]
) -> Complex[np.ndarray, "groups *contacts k"]:
    """These directions of the state in modal coordinates."""
    return np.einsum("gkm,g...m->g...k", to_modal, columns)


def _slowest_period(eigenvalues: np.ndarray) -> np.ndarray:
    lowest = np.min(np.where(eigenvalues.imag > 0, eigenvalues.imag, np.inf), axis=-1)
    return np.where(np.isfinite(lowest), 2 * np.pi / lowest, 0.0)


def _clusters(eigenvalues: np.ndarray) -> np.ndarray:
    """For each set of eigenvalues, in falling order of frequency, clusters of close modes as rows of ones and zeros."""
    # Modes whose eigenvalues are this close, relative to the largest, are bounded together, because they may be nearly
    # parallel.
    close = 0.2
    gaps = np.abs(np.diff(eigenvalues, axis=-1)) > close * np.abs(eigenvalues[:, :1])
    number = np.cumsum(np.concatenate([np.zeros((len(gaps), 1), int), gaps], axis=-1), axis=-1)
    return (number[:, None, :] == np.arange(number.max() + 1)[:, None]).astype(float)


def margin_share_bound(
    mechanics: Mechanics,
    modes: SlidingModes,
    contact: Contact,
    deviation: State,
    under_final_load: Bool[Array, ""] | bool,
) -> Float[Array, ""]:
    """The largest share of a margin, to the contact's opening or to its sticking, that a motion which slides now can ever use
    up: below 1 it slides for ever. Infinite where there is no such bound.

    `deviation` is that of the state from the equilibrium; without `under_final_load` nothing is known. With several contacts:
    all of them slide now, and none ever stops.
    """
    linear = modes.linear
    z = deviation[sliding_states(deviation.shape[0] // 2, mechanics.normal)]
    modal = complex_pairs.from_real(modes.to_modal, z)
    slides = (contact.status == Status.SLIDE) & (contact.direction == linear.direction)
    sliding = (jnp.all(slides) if mechanics.several else slides) & under_final_load
    sliding = sliding & modes.stable & linear.exists
    if not mechanics.friction.constant:
        of_all = _margin_share_of_several if mechanics.several else _margin_share_nonlinear
        return _where_known(sliding, of_all(modes, modal))
    members = modes.envelope.members
    parts = _parts(modes.pressing, modal, linear.pressing_margin) + _parts(modes.slip, modal, linear.slip_margin)
    # The bound is costly. As the body of a loop it is computed for a batch only if some trajectory needs it: one for which
    # pressing and slip, with each cluster of modes at its present size, are within their margins.
    for shares, margin in parts:
        of_clusters = Pair(members @ shares.real, members @ shares.imag)
        sliding = sliding & (jnp.sum(complex_pairs.size(of_clusters)) < margin)

    def bound(carry):
        _, _, signals = carry
        used = [envelope_peak(part, modes.envelope) / margin for part, (_, margin) in zip(signals, parts, strict=True)]
        # The loop changes `signals`, because XLA would move work on loop constants out of the loop and always compute it.
        return jnp.zeros_like(sliding), jnp.max(jnp.stack(used)), jax.tree.map(jnp.zeros_like, signals)

    begin = sliding, jnp.full_like(linear.slip_margin.ravel()[0], jnp.inf), [shares for shares, _ in parts]
    found = jax.lax.while_loop(lambda carry: carry[0], bound, begin)[1]
    return _where_known(sliding, found)


def _where_known(known: Bool[Array, ""], used: Float[Array, ""]) -> Float[Array, ""]:
    """No number, or a margin that is none, is no bound."""
    return jnp.where(known & (used >= 0), used, jnp.inf)


def _parts(shares, modal: Pair, margin: Float[Array, "*contacts"]) -> list[tuple[Pair, Float[Array, ""]]]:
    """For each contact: the modes' parts in a quantity with these shares, and how far it may fall."""
    parts = complex_pairs.times(shares, modal)
    return [(parts, margin)] if margin.ndim == 0 else [(parts[i], margin[i]) for i in range(len(margin))]


@in_double_precision
def why_withheld(scene: Scene) -> str | None:
    """Why no motion of this scene can be proved to slide for ever, as a sentence; None if that may be possible."""
    friction, count = scene.friction, len(scene.structure.contacts)
    laws = friction.laws if isinstance(friction, FrictionPerContact) else (friction,) * count
    for law, speed in zip(laws, np.broadcast_to(np.abs(np.asarray(scene.belt_speed)), count), strict=True):
        name = type(law).__name__
        if law.constant:
            continue
        if law.may_have_kinks:
            return (
                f"No motion is proved to slide for ever: the friction law `{name}` may have kinks (it compares, clips, takes "
                f"from a table, or takes a root or the inverse of what may be zero), and the proof needs a bound on its second "
                f"derivative. If it has none, say so: `smooth = True`."
            )
        bounds = [float(bound) for bound in law.variation(jnp.asarray(LOWEST_SLIP * speed))]
        if not np.all(np.isfinite(bounds)):
            return (
                f"No motion is proved to slide for ever: the friction law `{name}` has no finite bounds on its derivatives at "
                f"and above {LOWEST_SLIP * speed:g} m/s, half the belt's speed. Define `variation`."
            )
    return None


def envelope(eigenvalues: np.ndarray, clusters: np.ndarray) -> Envelope:
    """Tables for `envelope_peak`, for a batch of sets of decaying modes (leading axis), by NumPy.

    Clusters are rows of ones and zeros.
    """
    members = clusters[:, :, None, :]  # [set, cluster, instant, mode]
    own = np.where(np.isfinite(eigenvalues), eigenvalues, -1.0)[:, None, None, :]
    mean = np.sum(members * own, axis=-1, keepdims=True) / np.maximum(np.sum(members, axis=-1, keepdims=True), 1.0)
    offsets = members * (own - mean)
    # Long enough for a sum of sizes that is 10⁵ times too large to decay, and finer at the beginning, where the motion is
    # large.
    slowest = 1e-6 * np.max(np.abs(own), axis=-1, keepdims=True) + 1e-300
    decades = 12.0
    instants = 161
    horizon = decades / np.maximum(-mean.real, slowest)
    t = horizon * np.linspace(0.0, 1.0, instants)[:, None] ** 2
    with np.errstate(over="ignore", invalid="ignore"):
        growth = members * np.exp(offsets * t)
        return Envelope(
            growth=growth,
            bending=np.abs(growth) * np.abs(offsets) ** 2,
            decay=np.exp(mean.real * t[..., :-1, :])[..., 0],
            chord=np.diff(t, axis=-2)[..., 0] ** 2 / 8,
            last=(members * np.exp(own.real * horizon))[..., 0, :],
            members=clusters,
        )


def envelope_peak(shares: Complex[Array, " k"] | Pair, envelope: Envelope) -> Float[Array, ""]:
    r"""An upper bound on $\sup_{t ≥ 0} |\mathrm{Re} \sum_k a_k e^{λ_k t}|$ for decaying modes, which is tight for nearly
    parallel modes, too.

    Near a coalescence the shares $a_k$ are huge and cancel, so the sum of their sizes is a useless bound. With the mean
    exponent $\bar λ$ of such a cluster of modes taken out, $u(t) = \sum a_k e^{(λ_k - \bar λ) t}$ varies slowly: between two
    instants a time $h$ apart it lies within $h^2 \max|u''| / 8$ of the chord, and
    $|u''| ≤ \sum |a_k| |λ_k - \barλ|^2 e^{…}$ is small. After the last instant the sum of sizes has decayed and is a sufficient
    bound. Clusters are bounded one by one.
    """
    sizes = complex_pairs.size(shares)
    growth = envelope.growth
    real, imag = (
        growth.real @ shares.real - growth.imag @ shares.imag,
        growth.real @ shares.imag + growth.imag @ shares.real,
    )
    slow = real**2 + imag**2
    bend = envelope.bending @ sizes  # [cluster, instant]
    chord = jnp.sqrt(jnp.maximum(slow[:, 1:], slow[:, :-1])) + envelope.chord * jnp.maximum(bend[:, 1:], bend[:, :-1])
    peaks = jnp.maximum(jnp.max(envelope.decay * chord, axis=-1), envelope.last @ sizes)
    bound = jnp.sum(jnp.minimum(peaks, envelope.members @ sizes))
    return jnp.where(jnp.isfinite(bound), bound, jnp.inf)


def _margin_share_nonlinear(modes: SlidingModes, modal: Pair) -> Float[Array, ""]:
    r"""The share of what keeps it decaying that a motion uses up, for friction that depends on slip speed.

    The norm $E = \sum_k e_k |w_k|$ with $e_k = |s_k| + κ |p_k|$ bounds the change of slip speed by $E$ and that of the
    pressing acceleration by $E/κ$. The remainder of the linearisation is then at most $C E^2$, so
    $\dot E ≤ -r E + F C E^2$ with $r$ the slowest decay rate and $F = \sum e_k |f_k|$: once $F C E < r$, $E$ falls for ever.
    """
    linear = modes.linear
    balance = linear.slip_margin / linear.pressing_margin
    weights = complex_pairs.size(modes.slip) + balance * complex_pairs.size(modes.pressing)
    size = jnp.sum(weights * complex_pairs.size(modal))
    drive = jnp.sum(weights * complex_pairs.size(modes.remainder))
    bend = 0.5 * linear.pressing_margin * linear.remainder_curvature + linear.remainder_slope / balance
    return jnp.maximum(_share_of_decay(modes, drive * bend * size), size / (linear.reach * linear.slip_margin))


def _margin_share_of_several(modes: SlidingModes, modal: Pair) -> Float[Array, ""]:
    r"""The same for several contacts: $E = \sum_k e_k |w_k|$ with $e_k$ the largest share of a mode in any normal force or slip
    speed, relative to its margin. No slip speed then changes by more than $E$ times its margin, nor does a normal force under
    constant friction. Up to $E$ = `LinearSliding.reach` no normal force reaches zero either, the remainders are at most
    $c_i E^2$, and $\dot E ≤ -r E + \sum_i F_i c_i E^2$ with $F_i = \sum_k e_k |f_{ki}|$.
    """
    linear = modes.linear
    weights = jnp.maximum(_largest(modes.slip, linear.slip_margin), _largest(modes.pressing, linear.pressing_margin))
    size = jnp.sum(weights * complex_pairs.size(modal))
    drive = complex_pairs.size(modes.remainder) @ weights
    bend = linear.remainder_slope + 0.5 * linear.remainder_curvature
    return jnp.maximum(_share_of_decay(modes, jnp.sum(drive * bend) * size), size / linear.reach)


def _share_of_decay(modes: SlidingModes, growth: Float[Array, ""]) -> Float[Array, ""]:
    """A bound on growth (1/s) relative to the slowest decay rate. Where a mode does not decay, any growth is too much."""
    rate = -jnp.max(modes.eigenvalues.real)
    share = growth / jnp.where(rate > 0, rate, 1.0)
    return jnp.where(rate > 0, share, jnp.where(growth == 0, 0.0, jnp.inf))


def _largest(shares, margin: Float[Array, " contacts"]) -> Float[Array, " k"]:
    """The largest share of each mode in a quantity of any contact, relative to its margin."""
    return jnp.max(complex_pairs.size(shares) / margin[:, None], axis=0)
