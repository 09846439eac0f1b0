"""Estimators beyond plain least squares, and intervals with the stated coverage.

Glossary. All but output error solve estimating equations sum Z' w (y - X beta) = 0 over the same
filtered rows; they differ in the instruments Z and the weights w (`equations`):
 ls            Z = X, w = 1: the paper's.
 wls           w = 1 / scatter between repeats, per record and equation (`weighted`).
 iv            Z from the other repeats' rows: noise in X cannot bias it (`instruments`).
 robust        w falls for rows far outside the scatter (`robust`).
 output-error  simulates the model from free window starts and fits it to the samples
               (`output_error`); noise is in the outputs only.
`analysis.identify.estimation.refine` runs one, or chooses by the check on noise in the regressors.
"""

from __future__ import annotations
