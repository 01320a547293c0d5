"""Patterns and calibration boards on paper: flattened, cut into pages, drawn as vector paths at true scale."""
