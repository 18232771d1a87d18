"""From a laser return to a point in the map: poses, placement (eq. 1), error bodies and their shares (eq. 12, 14)."""
