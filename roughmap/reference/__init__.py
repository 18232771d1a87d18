"""The batch method of the paper, dividing and calculating, as the reference for the running update."""
