"""Benchmarks: accuracy and run time against peers, truth and photographs.

``python -m benchmarks`` lists them, and ``python -m benchmarks NAME --help`` describes one.
A benchmark is a module with a function `main`, whose parameters are its options.
"""
