"""Landing site selection, ground classification and the landing mission.

Consumes maps, estimates and images; imports no simulator. Other folders use ``landing.api``.
"""
