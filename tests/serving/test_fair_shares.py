"""Whose turn it is: clients in turn by the time that they take, small jobs first, no time and no threads."""

from nurec_sim.serving.sensor_service.fair_shares import FairShares, Job

TURN_S = 0.010


def anyone(job):
    return True


def served(shares, turns, seconds=None, may_run=anyone):
    """The clients of the next turns; jobs go on for ever, and each turn takes what ``seconds`` says of the client."""
    order = []
    for _ in range(turns):
        job = shares.take(may_run)
        order.append("/".join(job.client))
        shares.settle(job, (seconds or {}).get(order[-1], TURN_S))
        shares.offer(job)
    return order


def queue(*jobs):
    shares = FairShares(TURN_S)
    made = [Job(tuple(client.split("/")), rays) for client, rays in jobs]
    for job in made:
        shares.join(job)
    return shares, made


def test_clients_take_turns_however_many_jobs_each_has():
    shares, _ = queue(*[("greedy", 5)] * 200)
    assert served(shares, 3) == ["greedy"] * 3
    for _ in range(3):
        shares.join(Job(("modest",), 5))
    assert served(shares, 6) == ["modest", "greedy"] * 3  # who comes anew waits for no more than the turn at work


def test_a_job_of_many_rays_does_not_delay_other_clients():
    shares, _ = queue(("huge", 33_000_000), ("small", 60_000))
    assert served(shares, 4) == ["huge", "small", "huge", "small"]


def test_who_takes_thrice_as_long_gets_a_third_of_the_turns():
    shares, _ = queue(("slow", 1), ("quick", 1))
    order = served(shares, 400, {"slow": 3 * TURN_S})
    assert 295 <= order.count("quick") <= 305


def test_what_is_left_of_a_turn_comes_back():
    shares, _ = queue(("a", 1), ("b", 1))
    order = served(shares, 300, {"a": TURN_S / 2})
    assert 195 <= order.count("a") <= 205


def test_small_jobs_of_a_client_come_first_then_those_that_came_first():
    shares, jobs = queue(("a", 300), ("a", 100), ("a", 200), ("a", 100))
    assert [shares.take(anyone) for _ in jobs] == [jobs[1], jobs[3], jobs[2], jobs[0]]
    assert shares.take(anyone) is None


def test_addresses_share_before_their_connections_do():
    shares, _ = queue(*[(f"crowd/{k}", 1) for k in range(10)], ("lone/0", 1))
    order = served(shares, 40)
    assert order.count("lone/0") == 20
    assert {order.count(f"crowd/{k}") for k in range(10)} == {2}


def test_what_may_not_run_is_passed_over():
    shares, jobs = queue(("a", 1), ("a", 9), ("b", 9))
    assert served(shares, 4, may_run=lambda job: job.rays == 9) == ["a", "b", "a", "b"]
    assert shares.take(lambda job: False) is None


def test_who_comes_and_goes_does_not_keep_others_from_their_turns():
    """One job at a time, each begun when the last has ended, beside a client whose jobs never end."""
    shares, _ = queue(("stays", 1))
    order = []
    for _ in range(20):
        visitor = Job(("visitor",), 1)
        shares.join(visitor)
        job = shares.take(anyone)
        order.append(job.client[0])
        shares.settle(job, TURN_S)
        if job is visitor:
            shares.leave(job)
        else:
            shares.offer(job)
            shares.withdraw(visitor)
            shares.leave(visitor)
    assert order.count("stays") >= 9 and order.count("visitor") >= 9


def test_time_beside_turns_is_charged():
    shares, jobs = queue(("a", 1), ("b", 1))
    shares.charge(jobs[0], 3.5 * TURN_S)
    assert served(shares, 4) == ["b", "b", "b", "a"]  # three rounds pay for most of it


def test_jobs_that_left_are_forgotten():
    shares, jobs = queue(("a/1", 1), ("a/2", 1), ("b/1", 1))
    for job in jobs:
        shares.withdraw(job)
        shares.leave(job)
    assert shares.take(anyone) is None and not shares._all.members
