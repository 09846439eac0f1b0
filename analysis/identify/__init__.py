"""Parameters from records: the coupled method, the paper's other methods, estimators, checks."""
