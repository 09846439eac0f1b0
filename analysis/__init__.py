"""Analysis of records: differentiation, regressor rows, identification, validation, trace."""
