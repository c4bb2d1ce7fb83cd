"""Maps and basins: the verdicts on many trajectories, as labelled datasets.

Read first: `bistability`, a map from its arguments to its dataset; `one_trajectory`, what is computed of each; `jobs`, a
job's trajectories followed round by round. Then `engine` and `plan`, a run divided into jobs; `executors`, who runs them;
`following` and the kernels, who steps; `capture`, who is on which attractor; `resuming`, `checkpoint`, `store` and
`job_files`, what is on the disk.
"""
