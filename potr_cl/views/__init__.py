"""Views, each with some splats, resident or made again: the heart of the stages that look at views.

Follow it in this order:

1. visibility.py: what views may draw of a scene, and whether that pays. Pure NumPy. reached.py: what a sweep fetches
   of that, as a device finds it.
2. plan.py: views that are looked at with the same splats, and the ways to group all views. A plan
   is data: to look at views in another way, write another function there.
3. budget.py: how much memory there is, and which groups of a plan stay on the device. *Who decides what is resident?*
4. subsets.py: where a group's splats come from: all, named by numbers, or copied.
5. engine.py: brings the groups of a plan in; keeps those that fit, and streams the others. *What happens to a view that
   does not fit?*

A stage is a *use*: it says what it makes of a set of prepared views, and adds up exact integers by the splats' numbers
in the scene, so that plans, devices and computers give the same bits. Pruning is one (stages/pruning/removal.py), the
re-fit another (stages/refitting/own_views.py): it goes through :meth:`~potr_cl.views.engine.ViewEngine.walk`, to which
it makes no difference which views stay. Several devices make a plan each, of the numbers of their own views. A fit and
judging look at a view as often as it comes, in colours that nobody has seen before: they keep nothing but pictures.

targets.py has the pictures that views should show: rendered, read, kept, or made ahead. shares.py deals views and
splats out to computers. pictures.py renders large scenes.
"""
