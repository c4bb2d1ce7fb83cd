"""Whether neighbours part from motions on the section, or close in on them: by how much in many returns."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..section.return_maps import ReturnMaps, Section

# Over so many returns, again and again, it is asked whether neighbours part: the first turn directions to where they grow. On a
# torus they part no faster than linearly; in chaos exponentially.
PARTING_OVER = 48
# A motion that nothing has captured in its time is followed on for so many times as many returns at most: until neighbours
# have parted by so many e-folds since they were closest, or have closed in by so many since they were furthest apart. On a
# torus they part and close in by turns, by two or three e-folds. Where they have parted by more before they close in, the
# motion was chaotic for a time: another solver's rounding may lead to another attractor.
PARTING_TIMES, PARTED, CLOSED_IN, AS_ON_A_TORUS = 128, 30.0, 15.0, 7.0
# How far neighbours are apart at first, relative to their size.
APART = 1e-7


class Followed(NamedTuple):
    """What motions do in the long run."""

    chaotic: Bool[np.ndarray, " m"]  # neighbours part exponentially, or did for long
    closing_in: Bool[np.ndarray, " m"]  # neighbours close in exponentially, as they do on a cycle
    at: Section  # where the motions are then
    time: Float[np.ndarray, " m"]  # which that took, s
    events: Int[np.ndarray, " m"]  # contact events on the way


class _Parted(NamedTuple):
    """Motions and their neighbours after `PARTING_OVER` returns."""

    growth: Float[np.ndarray, " m"]  # the logarithm of the growth of their distance per return
    time: Float[np.ndarray, " m"]  # s
    events: Int[np.ndarray, " m"]
    at: Section
    beside: Float[np.ndarray, "m 2n"]  # neighbours in the direction in which those from before are by then
    path: Float[np.ndarray, "m k 2n"]  # the motions' weighted states on the section


def followed_on(maps: ReturnMaps, group: Int[np.ndarray, " m"], at: Section) -> Followed:
    """Whether neighbours part or close in exponentially where motions that start here lead to: asked over thousands of returns,
    because events may be rare. On a torus they do neither.
    """
    first = maps.returns(group, at, 1)
    _, time, events, at, beside, _ = _parted(maps, group, first.at, _beside(first.at))
    time, events = time + first.time, events + first.events
    running, last = np.arange(len(group)), Section(*(part.copy() for part in at))
    parted, least, most, furthest = np.zeros((4, len(group)))
    for _ in range(PARTING_TIMES):
        growth, taken, met, at, beside, _ = _parted(maps, group[running], at, beside)
        time[running] += taken
        events[running] += met
        parted[running] += PARTING_OVER * growth
        least, most = np.fmin(least, parted), np.fmax(most, parted)
        last.put(running, at)
        # Not a number is neither.
        with np.errstate(invalid="ignore"):
            furthest = np.fmax(furthest, parted - least)
            left = ((parted - least < PARTED) & (most - parted < CLOSED_IN))[running]
        running, at, beside = running[left], at.rows(left), beside[left]
        if not len(running):
            break
    with np.errstate(invalid="ignore"):
        closing_in = most - parted >= CLOSED_IN
        chaotic = furthest >= np.where(closing_in, AS_ON_A_TORUS, PARTED)
    return Followed(chaotic, closing_in & ~chaotic, last, time, events)


def parting_rates(maps: ReturnMaps, group, at: Section):
    """How fast neighbours part from motions that start here: the logarithm of the growth of their distance per return; where
    the motions are in the end; and their weighted states on the section.
    """
    beside, growth, paths = _beside(at), np.full(len(group), np.nan), []
    for _ in range(2):
        growth, _, _, at, beside, path = _parted(maps, group, at, beside)
        paths.append(path)
    return growth, at, np.concatenate(paths, axis=1)


def _beside(at: Section) -> Float[np.ndarray, "m 2n"]:
    """Neighbours, away from the equilibrium: that keeps what the section and the contact hold at zero."""
    return at.y * (1 + APART)


def _parted(maps: ReturnMaps, group, at: Section, beside) -> _Parted:
    weights = maps.weights
    size = np.linalg.norm(weights * at.y, axis=1, keepdims=True)
    apart = np.linalg.norm(weights * (beside - at.y), axis=1)
    pair = Section(*(np.concatenate(parts) for parts in zip(at, at._replace(y=beside), strict=True)))
    pair, events, time, path, _ = maps.returns(np.tile(group, 2), pair, PARTING_OVER, PARTING_OVER)
    own = slice(None, len(group))
    at, other = pair.rows(own), pair.rows(slice(len(group), None))
    away = weights * (other.y - at.y)
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        growth = np.log(distance[:, 0] / apart) / PARTING_OVER
        beside = at.y + APART * size * away / distance / weights
    return _Parted(growth, time[own], events[own], at, beside, weights * path[own])
