"""What the stage "refit" computes with. Begin with refit.py.

- refit.py solves for the colours of a scene, as refit_options.py says. The other files are its parts:
- colour_refit.py puts the problem of one scene and its views together, for any number of solutions;
- colour_map.py is the linear map from colours to pictures, whose kernels are launched in view_kernels.py;
- solver.py minimises the error, by conjugate gradients on the vectors of coefficients.py, with blocks.py as
  preconditioner;
- own_views.py walks the views that one worker does; shared_map.py adds what others have found, by way of exchange.py;
- placement.py decides where vectors and blocks lie, whole or in slices (sliced_arrays.py);
- rounding.py rounds colours in rounds while the solution goes on.
"""
