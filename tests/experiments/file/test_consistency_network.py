"""[hosts] and what of [network] belongs to it: what is wrong, where, and the remedy."""

import msgspec
import pytest

from experiments.definition.plan import Plan
from experiments.definition.standby import robots_without_address
from experiments.file import document
from experiments.file.document import case_document as line

HEAD = """\
title = "two"
duration_s = 5.0
[robots.A]
kind = "khepera4"
start = [0.0, 0.0]
[robots.B]
kind = "khepera4"
start = [0.5, 0.0]
"""
LAB = '[hosts.lab1]\naddress = "pi@192.0.2.7"\nrobots = ["A"]\n'


def problems(tmp_path, text):
    file = tmp_path / "x.toml"
    file.write_text(text)
    try:
        document.read(file)
    except document.DocumentError as error:
        return [(each.line, each.message, each.hint) for each in error.problems]
    return []


def test_a_good_one(tmp_path):
    text = HEAD + LAB + 'zenpark = "~/lab/zenpark"\nlab = "~/keys"\ntags = ["radio"]\n[hosts.board]\nrobots = ["B"]\n'
    assert problems(tmp_path, text) == []
    (tmp_path / "x.toml").write_text(text)
    experiment = document.read(tmp_path / "x.toml").experiment
    assert robots_without_address(Plan(experiment)) == {"B": "board"}
    sent = line(Plan(experiment))
    assert b"\n" not in sent
    there = document.received(sent.decode(), "standard input").experiment
    assert there == msgspec.structs.replace(experiment, hosts={})


@pytest.mark.parametrize(
    ("text", "at", "message", "hint"),
    [
        (HEAD + LAB.replace('"A"', '"C"'), 11, "no robot is called 'C'", "known: A, B"),
        (HEAD + LAB + '[hosts.lab2]\nrobots = ["B", "A"]\n', 13, "'A' runs on 'lab1' already", "one process"),
        (HEAD + LAB.replace("pi@", "-oProxyCommand=x"), 10, "no address that ssh takes", "~/.ssh/config"),
        (HEAD + LAB.replace("pi@", "pi @"), 10, "no address that ssh takes", "pi@192.0.2.7"),
        (HEAD + LAB + 'zenpark = "zenpark run"\n', 12, "no path of a command", "zenpark/zenpark"),
        (HEAD + LAB + "zenprk = 1\n", 12, "unknown key 'zenprk'", "did you mean 'zenpark'?"),
        (HEAD.replace("[robots.B]", 'process = "p"\n[robots.B]\nprocess = "p"') + LAB, 8, "share the process 'p'",
         "name both in the same host"),
        (HEAD.replace("[robots.B]", 'body = "khepera4-twin"\n[robots.B]') + LAB, 12, "behind a protocol twin",
         "let it run here"),
        (HEAD + '[network]\nlisten = ["tcp/0.0.0.0"]\n', 10, "is not an endpoint", "tcp/127.0.0.1:7447"),
        (HEAD + '[network]\nlisten = ["tcp/[::]:1"]\nconnect = ["tcp/lab:1"]\n', 10, "router that zenpark starts",
         "leave one of them out"),
        (HEAD + '[network]\naddress = "lab"\n', 10, "that is not given", "add listen"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, at, message, hint):
    ((line_number, told, remedy),) = problems(tmp_path, text)
    assert line_number == at
    assert message in told
    assert hint in remedy


@pytest.mark.parametrize(
    ("text", "at", "message", "hint"),
    [
        (
            'routers = 2\nconnect = ["tcp/lab:1"]\n',
            10,
            "with `connect` it starts none",
            "zenpark router --connect OTHER",
        ),
        ('routers = 2\nlisten = ["tcp/127.0.0.1:1"]\n', 10, "2 routers cannot share 1 endpoints", "of its own"),
        ('listen = ["udp/127.0.0.1:1"]\n', 10, "cannot be used: lost messages", "tls, quic or unixsock-stream/PATH"),
        ('topology = "mesh"\nrouters = 2\n', 11, "a mesh has no routers", "leave it out"),
        ('topology = "mesh"\nconnect = ["tcp/lab:1"]\n', 11, "a mesh has no routers", "leave it out"),
        ('topology = "mesh"\naddresses.C = "tcp/127.0.0.1:1"\n', 11, "no robot is called 'C'", "known: A, B"),
        ('topology = "mesh"\naddresses.A = "tcp/0.0.0.0:1"\n', 11, "a wildcard is no address", "its neighbours"),
        ('topology = "mesh"\naddresses.A = "ws/127.0.0.1:1"\n', 11, "shows no certificates", "tls"),
        ('topology = "mesh"\n' + LAB, 10, "its endpoint there is not given", "addresses.A"),
        ('addresses.A = "tcp/127.0.0.1:1"\n', 10, "where robots listen in a mesh", 'topology = "mesh"'),
    ],
)
def test_what_does_not_go_together_in_a_network(tmp_path, text, at, message, hint):
    found = problems(tmp_path, HEAD + "[network]\n" + text)
    assert len(found) == 1, found
    assert found[0][0] == at
    assert message in found[0][1]
    assert hint in found[0][2]


def test_several_routers_with_endpoints_of_their_own(tmp_path):
    assert problems(tmp_path, HEAD + '[network]\nrouters = 2\nlisten = ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"]\n') == []
    text = 'topology = "mesh"\naddresses.A = "tcp/127.0.0.1:1"\n'
    assert problems(tmp_path, HEAD + "[network]\n" + text) == []
