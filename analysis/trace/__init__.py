"""Trace: name the physical effect that an identified model lacks, or state why none is named.

Order of work, with the module of each step (`engine.trace` calls them):
 `data`: conditioned records, noise floor, whitened rows, candidates and their columns
 `search`: linear search for a set of effects, exact fits of the best sets
 `judge`: readings of one law, gates, errors on held-out records, intervals
 `free_forms`: mechanisms without a named form, where no name explains
 `judging`: all of these on given rows, with their answer and verdict (`finding`)
 `clues`: variables that the residual depends on where no effect explains it
 `next_experiment`: the experiment that answers the open question, detection limits
 `result`, `words`: the result as data, JSON and text

Terms:
 row: one instant of one equation (`torque_1`, `flow_cap_1`, `flow_rod_1`); M rows in all
 group: the repeats of one step of one run; a segment holds one equation's rows of one group
 energy above noise: sum of squared whitened residuals minus what noise alone gives
 effect: an entry of the catalogue at one place; `Used` is one at given shapes
 hypothesis: a fitted set of effects; the winner is the one that the search prefers
 mechanism, reading: the law behind several names; one of these names
 form error: difference between the catalogue's formula of an effect and the real effect
 choosing rows, judging rows: held-out rows that select effects; rows read once at the end
"""
