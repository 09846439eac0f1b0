"""The ways to identify that the paper compares its own with: one module each.

 sequential    step after step, E1 (use one step's value further on) and E2 (average the steps')
 simultaneous  only records that excite every joint at once
 search        pso and ga: search by simulation for the last joint's parameters (the paper's STEP1)

Each returns the same `Identification` as the coupled method, null where it has no number to give,
with what it could not do among the checks and its own figures under `extra`.
"""
