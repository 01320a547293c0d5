"""Photographs with truth, for tests, documentation and benchmarks."""
