"""Limit cycles and tori of the return map: how they are found, how they are shown to attract, and which motions they have
captured.

Read first: `neighbourhood`, what makes a cycle's capture a proof; `catalogue`, what is known of each group of scenes. Then
`closing` (Newton's method), `cycles`, `tube`, `returning` and `tori` (what counts as one), `approach` (what a cycle draws in
from afar), `search` (from where motions are released), `long_run` (what becomes of motions whose time is over) with `creeping`
and `divergence`.
"""
