"""What stands on the demo's course, and when."""

import torch

from torchelev.app.demo.course import PERSON_LEAVES, make_course


def test_person_is_gone_from_the_course_at_the_end():
    scene = make_course()
    person = torch.tensor([[3.7, 0.85]])
    assert bool(scene.is_covered(person, 0.0)) and not bool(scene.is_covered(person, PERSON_LEAVES + 2))
