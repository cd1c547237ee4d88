"""A question before an action that matters, as a page: what is about to happen, and one button that says it."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from api.sessions.questions import LIFE_S, gone
from api.web.dependencies import Ctx, Tester
from api.web.pages.render import page

router = APIRouter(include_in_schema=False, prefix="/participants/{code}/confirm")


@router.get("/{number}")
async def show(request: Request, context: Ctx, who: Tester, code: str, number: str) -> Response:
    """The question; or, where it has been answered, what came of it."""
    question = context.questions.find(code, number, who)
    if question.answer is None:
        return page(request, "question.html", question=question, minutes=LIFE_S / 60)
    if question.answer.done() and question.answer.exception() is None:
        return RedirectResponse(question.answer.result(), 303)
    raise gone("It has been answered.")


@router.post("/{number}")
async def answer(context: Ctx, who: Tester, code: str, number: str) -> Response:
    """Yes."""
    question = context.questions.find(code, number, who)
    return RedirectResponse(await context.questions.yes(question), 303)
