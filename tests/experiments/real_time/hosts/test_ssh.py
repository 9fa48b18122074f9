"""Errors of ssh, with remedies."""

import shlex

import pytest

from agents.network.endpoints import Endpoint
from agents.runtime.lifeline import BEAT_S, FAR_SILENCE_S
from experiments.real_time.hosts import ssh


@pytest.mark.parametrize(
    ("said", "cause", "remedy"),
    [
        ("ssh: connect to host 192.0.2.7 port 22: Connection refused", "cannot be reached", "sshd run"),
        ("ssh: connect to host lab1 port 22: Connection timed out", "cannot be reached", "Try ssh pi@lab1"),
        ("ssh: connect to host lab1 port 22: No route to host", "cannot be reached", "network"),
        ("ssh: Could not resolve hostname lab1: Name or service not known", "no machine of that name", "HostName"),
        ("No ED25519 host key is known for lab1 and you have requested strict checking.\nHost key verification failed.",
         "host key is not known", "ssh pi@lab1"),
        ("@    WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @\nHost key verification failed.",
         "not the one that is known", "ssh-keygen -R"),
        ("pi@lab1: Permission denied (publickey,password).", "none of our keys", "ssh-copy-id pi@lab1"),
        ("Error: remote port forwarding failed for listen port 0", "forwards no ports", "AllowTcpForwarding"),
        ("env: 'zenpark/zenpark': No such file or directory", "no zenpark at 'zenpark/zenpark'", "hosts install"),
        ("env: ‘zenpark/zenpark’: Permission denied", "may not be started", "chmod +x zenpark/zenpark"),
        ("/usr/bin/env: 'python3': No such file or directory", "no Python", "apt install python3"),
        ("Usage: zenpark [OPTIONS]\nError: No such command 'station'.", "too old", "hosts install"),
        ("Timeout, server lab1 not responding.", "connection to it broke", "still on"),
        ("something new\nthat nobody knows", "ssh failed: that nobody knows", "must ask nothing: ssh pi@lab1"),
        ("", "it said nothing", ""),
    ],
)  # fmt: skip
def test_trouble_has_a_cause_and_a_remedy(said, cause, remedy):
    told = ssh.explained("pi@lab1", "zenpark/zenpark", said)
    assert cause in told
    assert remedy in told


def test_words_arrive_as_they_are():
    words = ["env", "zenpark/zenpark", "agent", "a b", "$(reboot)", "it's"]
    command = ssh.command("pi@lab1", words, ["-R", "x"])
    assert command[-2] == "pi@lab1"
    assert command[-3] == "--", "an address never is an option"
    assert shlex.split(command[-1].removeprefix("exec ")) == words
    assert "BatchMode=yes" in command
    assert "-T" in command


def test_what_is_forwarded():
    assert ssh.forwarded(Endpoint.parse("tcp/127.0.0.1:7447")) == "127.0.0.1:0:127.0.0.1:7447"
    assert ssh.forwarded(Endpoint.parse("tls/[::1]:7447")) == "127.0.0.1:0:[::1]:7447"
    assert ssh.forwarded(Endpoint.parse("unixsock-stream//run/z")) == "127.0.0.1:0:/run/z"
    with pytest.raises(ValueError, match="use tcp or tls"):
        ssh.forwarded(Endpoint.parse("quic/127.0.0.1:7447"))


def test_which_ports_sshd_chose():
    said = (
        "Welcome\nAllocated port 36225 for remote forward to 127.0.0.1:7447\r\n"
        "Allocated port 41000 for remote forward to 127.0.0.1:7448\n"
    )
    assert ssh.allocated(said) == [36225, 41000]


def test_a_far_lifeline_outlasts_a_short_cut() -> None:
    sent_again_s = [0.2 * (2**k - 1) for k in range(1, 6)]  # after a cut: TCP doubles its pauses
    in_time = [at for at in sent_again_s if at + BEAT_S < FAR_SILENCE_S]
    assert in_time[-1] == pytest.approx(3.0)
    interval, count = (int(ssh.OPTIONS[f"ServerAlive{word}"]) for word in ("Interval", "CountMax"))
    assert interval * (count + 1) > FAR_SILENCE_S, "the connection lives as long"
