"""The query's 2-D pose graph: odometry, closures to the fixed map, and back-ends that optimise it.

Nothing here can reach the truth. `answers` says which closures each method gets, `odometry` how
far odometry can be believed, `consistency` which closures agree with one another (PCM), and
`optimise` solves the graph with GTSAM.
"""
