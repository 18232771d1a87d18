"""From points to cells: the two phases of an `add`, and the ordered update of cells (eq. 5, 13-16)."""
