"""From a laser return to a point in the map: poses, placement (eq. 1), error body and its shares (eq. 12, 14)."""
