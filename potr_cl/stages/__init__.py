"""What is done to a scene on the way to a file: one module a stage, and a folder for what each of them computes
with.
"""
