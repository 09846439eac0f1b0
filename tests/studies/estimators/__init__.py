"""Studies of estimators, intervals, filters and predicted errors."""
