"""Programs about the package, not of it: what they answer, and the command that does it.

Run them from the checkout's root, as in ``python -m tools.bench.pruning --help``. A SCENE is a folder that holds
point_cloud.ply and cameras.json. They print Markdown; most keep their figures with --json, for docs/benchmarks.

How fast, how large, how much memory (``bench``):

=====================  =================================================================================================
bench.encode           run time against error of variants of kernels on every device: what is on the Pareto front?
bench.rasterizer       frames a second, and time by kernel
bench.pruning          what does pruning keep, against other pruners?
bench.fit              how fast are the fit's steps?
bench.codec            how fast does the codec encode, and decode by compiled code, NumPy or OpenCL; in how much memory?
bench.paired           are whole encodes faster or slower than those of another checkout?
bench.scaling          how do time and memory of whole commands grow with splats, views and devices?
bench.levels           how close are levels of detail where they are shown, and do leaves' errors foretell pictures'?
bench.web              how fast is the browser's decoder against native C, and in how much memory?
=====================  =================================================================================================

What a choice costs or brings, against the alternatives (``study``):

=========================  =============================================================================================
study.rate_distortion      size against quality, of any options: presets, what the re-fit brings, what pruning may skip
study.time_error           what does each knob that trades run time for error cost and bring?
study.placed_views         what do placed views cost by how many they are, how large, and how much colours are held?
study.ablation             what does each part of the codec contribute?
study.formats              how small are encodes to the formats that viewers open, and what do others make of scenes?
=========================  =============================================================================================

What happens at the limits (``stress``):

==================  ====================================================================================================
stress.run          every kernel against float64 on the worst inputs: what error is the kernel's own?
stress.platforms    the rasterizer, the metrics and the re-fit on every OpenCL runtime of this machine
stress.offline      do all GPU programs build for AMD's, Intel's and Apple's GPUs, and do any spill registers?
stress.limits       encodes on a device that is told to be small and watched: do they fit, how long are kernels?
stress.simulated    does Oclgrind see a race, an access out of bounds or an uninitialised read in any kernel?
stress.fuzz         does any changed file do more than be refused or decode to finite numbers?
stress.bombs        what do files take that unpack to far more than they are, or claim to?
stress.determinism  does every command write the same bytes the second time?
stress.long_life    does a process that encodes, renders and compares all day grow?
stress.native       does the compiled decoder touch memory not its own, or differ from NumPy's, on changed files?
==================  ====================================================================================================

What tests and pages are made of (``make``):

====================  ==================================================================================================
make.large_scene      a scene of any size with the statistics of a real one
make.city             copies of trained scenes side by side, any number of splats and views
make.test_data        the excerpts in tests/data
make.release          a wheel and an sdist that are ready for a package index
make.readme_picture   the picture at the top of the README
make.other_tools      splats in the formats of six tools, and how splat-transform reads them
make.golden_files     files that every later decoder must read to the same values
make.native           the compiled part of the decoder, in the checkout
make.wheels          wheels for Linux, Windows and macOS, whose compiled part Zig builds here
make.web              the decoder for browsers, and the viewer of pages
make.docs             the pages and tables of README and docs that are made from the code (see CONTRIBUTING.md)
make.benchmarks       the tables and plots of docs/benchmarks, from the results beside them
====================  ==================================================================================================

Shared: :mod:`tools.results` (tables that say what they are of), :mod:`tools.workloads` (command lines, scenes, time and
memory), :mod:`tools.study.evaluation` (what a candidate loses to its scene). Tools import the package and the float64
definitions (:mod:`tests.reference`), no other tests; kernels of their own are given to a
:class:`potr_cl.opencl.device.Device` as variants. Their own tests are in tools/tests.
"""
