"""Parameters of a scene from recordings.

Read first: `fit`, what the user calls; `problem`, the residuals of a fit and their Jacobian; `search`, the way to its
minimum. What is compared: small motions and responses to kicks (`waveform_misfit`, by `responses` and `samples`), measured
poles (`mode_poles`, `characteristic`), limit cycles (`cycle_misfit`, by `folding` and `shooting`). What is concluded:
`goodness_of_fit`, `covariance`, `conclusion`.
"""
