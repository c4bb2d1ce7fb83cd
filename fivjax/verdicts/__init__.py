"""What is proved of a trajectory by its state alone: that it slides for ever, or sticks for ever.

Read first: `verdict`, the codes and what each says; `sliding_proof`, the bound on all that is to come. `slow_growth` skips
the time for which sliding is certain, `sticking_proof` says who jams on the belt. Capture by attractors is in `attractors`.
"""
