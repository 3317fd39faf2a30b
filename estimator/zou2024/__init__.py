"""The LIDAR-camera positioning of Zou, Sun and Kong 2024, sections 3.2 and 3.3.

Modules follow the paper: ``projection`` (Eqs. 1, 2), ``smoothness`` (Eqs. 6, 7),
``structured_edges`` and ``geodesic`` (Eqs. 8, 12), ``feature_map`` and ``registration`` (Eqs. 9,
10, Algorithm 1), ``landmarks``, ``matching``, ``pnp`` (Eq. 11), ``bundle``, and ``loop_closure``,
``verification``, ``closures`` and ``pose_graph`` (RTAB-Map). Each equation is one named function.
"""
