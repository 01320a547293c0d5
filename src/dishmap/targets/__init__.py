"""Printed targets: what is printed, finding it, naming it, and measuring each target's pose."""
