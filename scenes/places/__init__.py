"""The named scenes: one folder each with its MJCF file and its `generate(seed)`."""
