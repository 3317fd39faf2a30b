"""The LIDAR-camera positioning of Zou, Sun and Kong 2024, sections 3.2 and 3.3.

Modules follow the paper: ``lidar_pose`` (Eqs. 6, 7), ``structured_edges`` and ``depth_field``
(Eqs. 8, 12), ``feature_map`` and ``registration`` (Eqs. 9, 10, Algorithm 1), ``visual_map`` (Eq.
2), ``bundle`` (Eq. 11), and ``place_recognition`` and ``closures`` (RTAB-Map). Each equation is
one named function.
"""
