"""The paper's sections IV and V, run on a simulated bench."""
