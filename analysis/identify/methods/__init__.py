"""The methods that the paper compares its coupled method with: one module each.

 sequential         step after step, E1 (use one step's value further on), E2 (average the steps')
 simultaneous       only records that excite every joint at once
 population_search  pso and ga: search by simulation for the last joint's parameters (the paper's
                    STEP1), each candidate judged by `search`

Each returns the same `Identification` as the coupled method, NaN where it gives no value; checks
state what it could not do, `extra` holds its own figures.
"""
