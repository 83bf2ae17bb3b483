def analytic_step(*a): raise NotImplementedError
