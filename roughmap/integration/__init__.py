"""Points into cells: the two phases of an `add`, and the ordered update (eq. 5, 13-16)."""
