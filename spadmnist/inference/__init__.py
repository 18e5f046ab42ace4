"""Inference: goodness of fit, diagnosis and fits of a model against measurements, by simulation.

Its chapters, in reading order:

models, replicates, reduction     what a model records of a capture, and the statistics of that
capture_replicates                the replicates of one capture
laws, null_distribution           how cells scatter if the model is right; residuals
contrasts                         patterns of all cells that are tested by themselves
light_levels                      the nuisance parameter of every capture, from its total
closed_forms, mean_alone          that total by the effects' closed forms; captures of which the mean alone is known
evaluation, checks                residuals of one model; its goodness of fit, one for all verbs
totals_tests, light_checks        the totals, the light, the pixels' ratios between wavelengths
captures_together                 what no capture shows by itself
deviations                        failing checks that show one deviation
comparison                        `compare`: does the model fit?
candidates, coordinates           every one-step change of a model, and its free numbers
signature, score_test             the shift of every cell that a candidate makes; the data's projection on it
scan, sharper_tests               all candidates with a few replicates; the most significant ones with more
trial_fits, gauss_newton          fits of one candidate, and of all numbers, with covariance
map_trials, map_fits              maps of pixels, by empirical Bayes
mixed_model                       patterns over the array and random differences of pixels, fitted together
random_pixels, hit_pixels         effects that hit pixels at random
evidence                          the measure by which fitted models are compared
held_out, time_blocks             what was left out of a fit: a capture, or every other block of time
setups                            the laboratory, not the sensor, differs from what is stated
model_selection                   `diagnose`: forward selection, then backward elimination
forward_step, elimination         a step is added; steps are dropped
joint_fit, intervals              all numbers together; their final values and intervals
alternatives, experiment_design   what is confused with a step; the capture that separates the two
upper_limits                      how strong what was not found may be
error_budget                      the ladder and its placebo
conclusion, findings, next_step   the verdict, what remains, what to do with the answer
results                           the answer as JSON, for a terminal, for the next sensor file
named_fit                         `fit`: named parameters
exact_likelihood, point_process   fits without simulation, where the likelihood has a closed form
bounded_step                      the highest point of a parabola within bounds
profile_likelihood                its maximum, and where it has fallen by a given amount
budget, journal                   how much work a search may do; its replicates on disk, from which it goes on
replicate_cache, own_code         replicates that are kept for another measurement; the user's code that made them
memory                            the memory that replicates take
levels                            what each decision costs in false alarms
"""
