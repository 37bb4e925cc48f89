"""Processes for the tests of background work; little is imported here, so that they start quickly."""

import multiprocessing
import os
import time

from nurec_sim.training.workers import work_in_background


def sleeping_worker(pipe):
    work_in_background(1)
    pipe.send(os.getpid())
    time.sleep(60)


def parent_of_a_worker(pipe):
    child = multiprocessing.get_context("spawn").Process(target=sleeping_worker, args=(pipe,))
    child.start()
    child.join()
