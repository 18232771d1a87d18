"""The map built by dividing and calculating: the oracle of the running update, and the paper's second half."""
