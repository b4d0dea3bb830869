"""What the stage "refit" computes with. Begin with refit.py.

- refit.py solves for the colours of a scene, as refit_options.py says. The other files are its parts:
- colour_refit.py puts the problem of one scene and its views together, for any number of solutions;
- colour_map.py is the linear map from colours to pictures, whose kernels are launched in view_kernels.py;
- solver.py minimises the error, by conjugate gradients on the vectors of coefficients.py, which lie on the device or in
  slices on the host (sliced_arrays.py), with blocks.py as preconditioner, which also rounds colours;
- own_views.py walks the views that one worker does; helpers.py adds what others have found, by way of exchange.py.
"""
