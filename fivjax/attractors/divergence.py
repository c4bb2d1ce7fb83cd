"""Whether neighbouring motions diverge, as in chaos, or close in on each other, as on a cycle: the growth of the distance
between them over many returns, of which the largest Lyapunov exponent of the return map is the limit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section
from .motions import Motions

# Growth is measured over so many returns, at most so often: the first returns turn deviations to where they grow. On a torus
# neighbours part no faster than linearly; in chaos exponentially.
WINDOW_RETURNS, MOST_WINDOWS = 48, 128
# How far neighbours are apart at first, relative to their size.
APART = 1e-7
# Neighbours have parted by so many e-folds since they were closest, as in chaos; or closed in by so many since they were
# furthest apart, as on a cycle. On a torus they do both by turns, by two or three e-folds.
PARTED, CLOSED_IN = 30.0, 15.0
# Which motions have come to something that is known.
Arrived = Callable[[Motions], Bool[np.ndarray, " m"]]
# Returns after which a neighbour is brought near again along a motion that is known: what parts slowly is still near then.
RETURNS_ALONG = 128


class Divergence(NamedTuple):
    """What motions do in the long run."""

    chaotic: Bool[np.ndarray, " m"]  # neighbours part exponentially, or did for long
    closing_in: Bool[np.ndarray, " m"]  # neighbours close in exponentially, as they do on a cycle
    at: Section  # where the motions are then
    time: Float[np.ndarray, " m"]  # which that took, s
    changes: Int[np.ndarray, " m"]  # of a contact's status on the way


class _Growth(NamedTuple):
    """Motions and their neighbours after `WINDOW_RETURNS` returns."""

    growth: Float[np.ndarray, " m"]  # the logarithm of the growth of their distance per return
    time: Float[np.ndarray, " m"]  # s
    changes: Int[np.ndarray, " m"]
    at: Section
    beside: Float[np.ndarray, "m 2n"]  # neighbours in the direction in which those from before are by then
    path: Float[np.ndarray, "m k 2n"]  # the motions' weighted states on the section


def long_divergence(
    maps: ReturnMaps, motions: Motions, chaotic_from: float = PARTED, arrived: Arrived | None = None
) -> Divergence:
    """Whether neighbours part or close in exponentially where these motions lead to: asked over thousands of returns, because
    events may be rare. On a torus they do neither. They part exponentially if it is by so many e-folds. Of those that have
    `arrived` on the way it is not asked any further.
    """
    # After so many measurements each it is asked which motions have arrived.
    arriving = 8
    group = motions.group
    first = maps.returns(*motions, 1)
    _, time, changes, at, beside, _ = _growth(maps, Motions(group, first.at), _beside(first.at))
    time, changes = time + first.time, changes + first.changes
    running, last = np.arange(len(group)), Section(*(part.copy() for part in at))
    parted, least, most, furthest = np.zeros((4, len(group)))
    for turn in range(MOST_WINDOWS):
        before = np.linalg.norm(maps.weights * at.y, axis=1)
        growth, taken, changed, at, beside, _ = _growth(maps, Motions(group[running], at), beside)
        time[running] += taken
        changes[running] += changed
        # One that has faded comes back no more in the end, and where it was is then lost.
        lasts = maps.moves(group[running], at.y)
        # Relative to their size: about the equilibrium neighbours part, or close in, as the motion grows, or fades. What
        # rounding does to neighbours of a tiny motion is neither.
        with np.errstate(divide="ignore", invalid="ignore"):
            more = WINDOW_RETURNS * growth - np.log(np.linalg.norm(maps.weights * at.y, axis=1) / before)
            parted[running] += np.where(APART * before > 64 * maps.resolution[group[running]], more, 0.0)
        least, most = np.fmin(least, parted), np.fmax(most, parted)
        there = np.all(np.isfinite(at.y), axis=1)
        last.put(running[there], at.rows(there))
        # Not a number is neither.
        with np.errstate(invalid="ignore"):
            furthest = np.fmax(furthest, parted - least)
            left = ((parted - least < chaotic_from) & (most - parted < CLOSED_IN))[running] & lasts
        if arrived is not None and turn % arriving == arriving - 1:
            left &= ~arrived(Motions(group[running], at))
        running, at, beside = running[left], at.rows(left), beside[left]
        if not len(running):
            break
    with np.errstate(invalid="ignore"):
        closing_in = most - parted >= CLOSED_IN
        # Where they have parted by more than on a torus before they close in, the motion was chaotic for a time: another
        # solver's rounding may lead to another attractor.
        chaotic = furthest >= np.where(closing_in, 7.0, chaotic_from)
    return Divergence(chaotic, closing_in & ~chaotic, last, time, changes)


def diverges_along(
    maps: ReturnMaps, group: Int[np.ndarray, " m"], paths: Float[np.ndarray, "m k 2n"]
) -> Bool[np.ndarray, " m"]:
    """Whether neighbours part exponentially along these motions, by their weighted states on the section in order: chaos that
    is as weak as an e-fold in some hundred returns looks like a torus in all other respects.
    """
    # What may be a torus is followed for longer where neighbours have parted by so many; and is none if they then part by so
    # many.
    suspicious, parted_on_torus = 4.0, 12.0
    states = paths / maps.weights
    beside, parted = states[:, 0] * (1 + APART), np.zeros(len(group))
    furthest = np.zeros(len(group))
    for start in range(0, states.shape[1] - RETURNS_ALONG, RETURNS_ALONG):
        here, there = states[:, start], states[:, start + RETURNS_ALONG]
        apart = np.linalg.norm(maps.weights * (beside - here), axis=1)
        at = maps.with_modes(group, beside)
        away = maps.weights * (maps.returns(group, at, RETURNS_ALONG).at.y - there)
        size = np.linalg.norm(maps.weights * there, axis=1, keepdims=True)
        beside, distance = _brought_near(maps, there, away, size)
        with np.errstate(divide="ignore", invalid="ignore"):
            parted = np.fmax(parted + np.log(distance / apart), 0.0)
        furthest = np.fmax(furthest, parted)
    chaotic, rows = np.zeros(len(group), bool), np.flatnonzero(~(furthest < suspicious))
    if len(rows):
        at = maps.with_modes(group[rows], states[rows, -1])
        chaotic[rows] = long_divergence(maps, Motions(group[rows], at), parted_on_torus).chaotic
    return chaotic


def growth_rates(maps: ReturnMaps, motions: Motions):
    """How fast neighbours part from these motions: the logarithm of the growth of their distance per return; where the motions
    are in the end; and their weighted states on the section.
    """
    group, at = motions
    beside, growth, paths = _beside(at), np.full(len(group), np.nan), []
    for _ in range(2):
        growth, _, _, at, beside, path = _growth(maps, Motions(group, at), beside)
        paths.append(path)
    return growth, at, np.concatenate(paths, axis=1)


def _beside(at: Section) -> Float[np.ndarray, "m 2n"]:
    """Neighbours, away from the equilibrium: that keeps what the section and the contact hold at zero."""
    return at.y * (1 + APART)


def _brought_near(maps: ReturnMaps, y, away: Float[np.ndarray, "m 2n"], size: Float[np.ndarray, "m 1"]):
    """Neighbours of states in these weighted directions, near again, relative to their `size`; and how far they were away."""
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return y + APART * size * away / distance / maps.weights, distance[:, 0]


def _growth(maps: ReturnMaps, motions: Motions, beside) -> _Growth:
    weights, (group, at) = maps.weights, motions
    size = np.linalg.norm(weights * at.y, axis=1, keepdims=True)
    apart = np.linalg.norm(weights * (beside - at.y), axis=1)
    pair = Section(*(np.concatenate(parts) for parts in zip(at, at._replace(y=beside), strict=True)))
    pair, _, changes, time, path, _ = maps.returns(np.tile(group, 2), pair, WINDOW_RETURNS, WINDOW_RETURNS)
    own = slice(None, len(group))
    at, other = pair.rows(own), pair.rows(slice(len(group), None))
    away = weights * (other.y - at.y)
    beside, distance = _brought_near(maps, at.y, away, size)
    with np.errstate(divide="ignore", invalid="ignore"):
        growth = np.log(distance / apart) / WINDOW_RETURNS
    return _Growth(growth, time[own], changes[own], at, beside, weights * path[own])
