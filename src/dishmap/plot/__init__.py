"""Pictures as SVG text: maps over the dish, the marked photograph, charts of a calibration."""
