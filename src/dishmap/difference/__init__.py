"""What changed between two photographs, and the dish rim that both are seen against."""
