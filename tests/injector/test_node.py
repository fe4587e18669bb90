"""Whom the injector has stand while it strikes."""

import os
from dataclasses import replace

from injector.node import bystanders
from services.bus.announce import Announcement

TARGET = Announcement("control", 100, 100, 1, "this boot")


def test_all_nodes_of_the_host_stand_but_the_target_and_itself() -> None:
    planning = replace(TARGET, name="planning", pid=101)
    itself = replace(TARGET, name="injector", pid=os.getpid())
    announced = {one.name: one for one in (planning, TARGET, itself)}
    assert bystanders(announced, TARGET) == [planning]


def test_a_node_of_another_host_is_let_alone_whatever_its_pid() -> None:
    far = replace(TARGET, name="sim", pid=1, boot_id="another boot")
    same = replace(TARGET, name="sim", boot_id="another boot")
    for one in (far, same):
        assert bystanders({"sim": one, "control": TARGET}, TARGET) == []
