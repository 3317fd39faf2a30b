"""Which places look alike, as in RTAB-Map (Labbé and Michaud 2013 and 2018): ``dictionary`` of
visual words, ``memory`` of the locations, and ``hypotheses``, the Bayesian filter over them.
"""
