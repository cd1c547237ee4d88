code = 'P017';
[text, etag] = ask(['/v1/participants/' code '/model'], '', '');
model = jsondecode(text);
n = round(4 * model.pulse_rate_hz);
reference_nm = 0.5 * model.recruitment.inverse.torque_nm(end) * sin(pi * (0:n-1)' / n).^2;
asked_nm = reference_nm;
for number = 1:6
    plan = jsondecode(ask(['/v1/models/' model.model_id '/widths'], ...
        jsonencode(struct('reference_torque_nm', asked_nm)), ''));
    torque_nm = play(code, model.pulse_rate_hz, etag, plan.pulse_width_us);
    error_nm = reference_nm - torque_nm;
    fprintf('trial %d: %.1f %%\n', number, 100 * norm(error_nm) / norm(reference_nm));
    tracked = jsondecode(ask(['/v1/participants/' code '/model?tracked=true'], '', ''));
    if isfield(tracked, 'tracking') && isfield(tracked.tracking, 'ask') && ~isempty(tracked.tracking.ask)
        error('stimrig:ask', 'a person has to look first: %s', tracked.tracking.ask);
    end
    smooth_nm = conv(error_nm, ones(7, 1) / 7, 'same');     % noise is not learnt
    asked_nm = max(0, asked_nm + 0.7 * smooth_nm);
end
